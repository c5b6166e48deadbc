"""What to look at next: proposals to review, or frames whose labels would teach most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from annotator.project import REVIEWED, Project, StoredFrame, StoredLabel
from annotator.types import ReviewState
from annotator.workflows.doubt import doubt


class Order(StrEnum):
    """WORST: most doubtful proposal first. TIME: frame by frame. CLASS: class by class, worst first within each.

    TEACH: frames to draw on, those first whose boxes would teach the detectors most: no label and no proposal yet,
    farthest from the labelled ones of the recording; then the most doubtful proposals.
    """

    WORST = "worst"
    TIME = "time"
    CLASS = "class"
    TEACH = "teach"


@dataclass(frozen=True)
class QueueItem:
    """One thing to look at.

    Attributes:
        frame: where.
        uid: of the proposal, or None for a whole frame.
        label: its class, or None.
        doubt: in 0..1, where it was measured.
    """

    frame: StoredFrame
    uid: str | None
    label: str | None
    doubt: float | None


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
    frames = {frame.id: frame for frame in project.frames.of(chosen) if frame.index is not None and not frame.finalised}
    if order is Order.TEACH:
        return tuple(_to_teach(project, frames, chosen))
    classes = None if label is None else [label]
    found = project.labels.select(states=[ReviewState.PROPOSED], recordings=chosen, classes=classes)
    items = [_item(frames[stored.frame_id], stored) for stored in found if stored.frame_id in frames]
    if order is Order.WORST:
        items.sort(key=_least_doubt)
    elif order is Order.CLASS:
        items.sort(key=lambda item: (item.label or "", _least_doubt(item)))
    return tuple(items)


def _item(frame: StoredFrame, stored: StoredLabel) -> QueueItem:
    return QueueItem(frame, stored.label.uid, stored.label.label, doubt(stored.quality, stored.label.score))


def _least_doubt(item: QueueItem) -> float:
    return -(item.doubt or 0.0)


def _to_teach(project: Project, frames: dict[int, StoredFrame], chosen: list[int] | None) -> list[QueueItem]:
    drawn = {boxes.frame_id for boxes in project.boxes.on_images()}
    known = drawn | {stored.frame_id for stored in project.labels.select(states=REVIEWED, recordings=chosen)}
    worst: dict[int, float] = {}
    for stored in project.labels.select(states=[ReviewState.PROPOSED], recordings=chosen):
        value = doubt(stored.quality, stored.label.score) or 0.0
        worst[stored.frame_id] = max(worst.get(stored.frame_id, 0.0), value)
    untouched = [frame for frame in frames.values() if frame.id not in known and frame.id not in worst]
    seen = [frame for frame in project.frames.of(chosen) if frame.id in known and frame.index is not None]
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
    by_recording: dict[int, list[StoredFrame]] = {}
    for recording in dict.fromkeys(frame.recording_id for frame in frames):
        own = sorted((f for f in frames if f.recording_id == recording), key=lambda f: f.index or 0)
        labelled = sorted(f.index or 0 for f in seen if f.recording_id == recording)
        by_recording[recording] = _widest_first(own, labelled)
    turns: list[StoredFrame] = []
    while any(by_recording.values()):
        turns += [own.pop(0) for own in by_recording.values() if own]
    return turns


def _widest_first(frames: list[StoredFrame], labelled: list[int]) -> list[StoredFrame]:
    places = [frame.index or 0 for frame in frames]
    if not labelled:
        # the first frame is where an operator begins
        order = _halving(0, len(frames) - 1)
        return [frames[n] for n in order]
    distance = {
        frame.id: min(abs(place - other) for other in labelled) for frame, place in zip(frames, places, strict=True)
    }
    halves = {number: rank for rank, number in enumerate(_halving(0, len(frames) - 1))}
    ranked = sorted(range(len(frames)), key=lambda n: (-_octave(distance[frames[n].id]), halves[n]))
    return [frames[n] for n in ranked]


def _octave(distance: int) -> int:
    """Distances that differ little are as good as each other."""
    return distance.bit_length()


def _halving(first: int, last: int) -> list[int]:
    """All numbers of a range: both ends, the middle, the middles of what is left ..."""
    if last < first:
        return []
    order, gaps = [first], [(first, last)]
    if last > first:
        order.append(last)
    while gaps:
        low, high = gaps.pop(0)
        if high - low < 2:
            continue
        middle = (low + high) // 2
        order.append(middle)
        gaps += [(low, middle), (middle, high)]
    return order
