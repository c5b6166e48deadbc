"""What to look at next: proposals to review, or frames whose labels would teach most."""

from __future__ import annotations

from bisect import bisect_left
from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import zip_longest

from annotator.project import REVIEWED, LabelSignals, Project, StoredFrame
from annotator.types import ReviewState
from annotator.workflows.doubt import doubt


class Order(StrEnum):
    """WORST: most doubtful proposal first. TIME: frame by frame. CLASS: class by class, worst first within each.

    TRACK: object by object over each recording; those without a track last, frame by frame.

    TEACH: frames to draw on, those first whose boxes would teach the detectors most: no label and no proposal yet,
    farthest from the labelled ones of the recording; then the most doubtful proposals.
    """

    WORST = "worst"
    TIME = "time"
    CLASS = "class"
    TRACK = "track"
    TEACH = "teach"


@dataclass(frozen=True)
class QueueItem:
    """One thing to look at.

    Attributes:
        frame: where.
        uid: of the proposal, or None for a whole frame.
        label: its class, or None.
        doubt: in 0..1, where it was measured.
        track_id: of the proposal's object, where known.
    """

    frame: StoredFrame
    uid: str | None
    label: str | None
    doubt: float | None
    track_id: int | None = None


def queue(
    project: Project, order: Order, recording: int | None = None, label: str | None = None
) -> tuple[QueueItem, ...]:
    """All that waits, in order. Frames that are finalised, or no longer in their recording, are left out.

    Args:
        recording: of this recording only.
        label: proposals of this class only; frames to teach are of no class.

    Raises:
        NotFoundError: no such recording.
    """
    if recording is not None:
        project.recordings.get(recording)
    chosen = None if recording is None else [recording]
    present = [frame for frame in project.frames.of(chosen) if frame.index is not None]
    frames = {frame.id: frame for frame in present if not frame.finalised}
    if order is Order.TEACH:
        return tuple(_to_teach(project, frames, present, chosen))
    classes = None if label is None else [label]
    found = project.labels.signals(states=[ReviewState.PROPOSED], recordings=chosen, classes=classes)
    items = [_item(frames[signals.frame_id], signals) for signals in found if signals.frame_id in frames]
    if order is Order.WORST:
        items.sort(key=_least_doubt)
    elif order is Order.CLASS:
        items.sort(key=lambda item: (item.label or "", _least_doubt(item)))
    elif order is Order.TRACK:
        # the sort keeps the frames' order within a track
        items.sort(key=lambda item: (item.frame.recording_id, item.track_id is None, item.track_id or 0))
    return tuple(items)


def _item(frame: StoredFrame, signals: LabelSignals) -> QueueItem:
    return QueueItem(frame, signals.uid, signals.label, doubt(signals.quality, signals.score), signals.track_id)


def _least_doubt(item: QueueItem) -> float:
    return -(item.doubt or 0.0)


def _to_teach(
    project: Project, frames: Mapping[int, StoredFrame], present: Sequence[StoredFrame], chosen: list[int] | None
) -> list[QueueItem]:
    known = project.boxes.frames_with_images() | project.labels.frames(states=REVIEWED, recordings=chosen)
    worst: dict[int, float] = {}
    for signals in project.labels.signals(states=[ReviewState.PROPOSED], recordings=chosen):
        value = doubt(signals.quality, signals.score) or 0.0
        worst[signals.frame_id] = max(worst.get(signals.frame_id, 0.0), value)
    untouched = [frame for frame in frames.values() if frame.id not in known and frame.id not in worst]
    seen = [frame for frame in present if frame.id in known]
    ordered = [QueueItem(frame, None, None, None) for frame in _spread(untouched, seen)]
    doubtful = sorted((frame_id for frame_id in worst if frame_id in frames), key=lambda frame_id: -worst[frame_id])
    proposed = [QueueItem(frames[frame_id], None, None, worst[frame_id]) for frame_id in doubtful]
    # once there are proposals, the least agreement teaches most; frames without any come behind the doubtful half
    sure = sum(worst[item.frame.id] < 0.5 for item in proposed)
    return [*proposed[: len(proposed) - sure], *ordered, *proposed[len(proposed) - sure :]]


def _spread(frames: Sequence[StoredFrame], seen: Sequence[StoredFrame]) -> list[StoredFrame]:
    """Frames so that each comes from the widest gap of its recording that is left: neighbours look alike.

    Taken recording by recording in turn.
    """
    labelled: dict[int, list[int]] = defaultdict(list)
    for frame in seen:
        labelled[frame.recording_id].append(frame.index or 0)
    by_recording: dict[int, list[StoredFrame]] = defaultdict(list)
    for frame in frames:
        by_recording[frame.recording_id].append(frame)
    orders = [
        _widest_first(sorted(own, key=lambda frame: frame.index or 0), sorted(labelled[recording]))
        for recording, own in by_recording.items()
    ]
    return [frame for turn in zip_longest(*orders) for frame in turn if frame is not None]


def _widest_first(frames: Sequence[StoredFrame], labelled: Sequence[int]) -> list[StoredFrame]:
    """Both in the order of the recording; frames and places in it."""
    halving = _halving(0, len(frames) - 1)
    if labelled:
        # the sort keeps the order of equals
        halving.sort(key=lambda number: -_octave(_distance(frames[number].index or 0, labelled)))
    # without any, the first frame is where an operator begins
    return [frames[number] for number in halving]


def _distance(place: int, labelled: Sequence[int]) -> int:
    """How far the nearest one is; `labelled` is sorted and not empty."""
    behind = bisect_left(labelled, place)
    return min(abs(place - other) for other in labelled[max(behind - 1, 0) : behind + 1])


def _octave(distance: int) -> int:
    """Distances that differ little are as good as each other."""
    return distance.bit_length()


def _halving(first: int, last: int) -> list[int]:
    """All numbers of a range: both ends, the middle, the middles of what is left ..."""
    if last < first:
        return []
    order, gaps = [first], deque([(first, last)])
    if last > first:
        order.append(last)
    while gaps:
        low, high = gaps.popleft()
        if high - low < 2:
            continue
        middle = (low + high) // 2
        order.append(middle)
        gaps.extend([(low, middle), (middle, high)])
    return order
