"""The review queue: proposals to review, or frames to label for training, in order of priority.

Proposals are sorted by their doubt:

    doubt = 1 - (1 - d1) (1 - d2) (1 - d3) (1 - d4) (1 - d5) (1 - d6)

Each d comes from one signal (`SIGNALS`) and grows linearly from 0 (good) to `MAX_DOUBT`, reached at the signal's bad
value. So one bad signal is enough to bring a proposal forward, and several add up. Signals without a value are left
out. Rank correlation (Spearman) of the doubt without the last signal with 1 - IoU to truth over 27 proposals on a
generated recording, detectors 1 and 8 % off: 0.66 (boxes 0.79, silhouettes 0.50). Of the single signals, the last
change (0.69) and the image (0.39) correlate most; the lost share hardly correlates, so its bad value is high.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import defaultdict, deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import zip_longest

from annotator.project import REVIEWED, Project, StoredFrame
from annotator.project.review import MAX_DOUBT, SIGNALS, By, QueueItem, ValueFilter, waiting, worst_of_frames
from annotator.types import Quality


def doubt(quality: Quality | None, score: float | None) -> float | None:
    """Returns the doubt in 0..1, or None for a box without signals: copied, or of other software without scores."""
    if quality is None and score is None:
        return None
    trust = 1.0
    for name, (good, bad) in SIGNALS.items():
        value = score if name == "score" else getattr(quality, name, None)
        if value is not None and not math.isnan(value):
            trust *= 1.0 - MAX_DOUBT * min(max((value - good) / (bad - good), 0.0), 1.0)
    return 1.0 - trust


class Order(StrEnum):
    """The order of the queue.

    WORST: most doubtful proposal first.
    TIME: frame by frame.
    CLASS: class by class, most doubtful first within each.
    TRACK: track by track within each recording; proposals without a track last, frame by frame.
    TEACH: frames whose labels help training most: frames with doubtful proposals first, then frames without labels and
        proposals (those farthest from labelled ones first), then frames whose proposals are all certain.
    """

    WORST = "worst"
    TIME = "time"
    CLASS = "class"
    TRACK = "track"
    TEACH = "teach"


@dataclass(frozen=True)
class Queue:
    """The first items of a queue, and the number of all."""

    items: tuple[QueueItem, ...]
    total: int


_BY = {Order.WORST: By.DOUBT, Order.TIME: By.FRAME, Order.CLASS: By.CLASS, Order.TRACK: By.TRACK}


def queue(
    project: Project,
    order: Order,
    label: str | None = None,
    attribute: ValueFilter | None = None,
    source: str | None = None,
    most: int | None = None,
) -> Queue:
    """Returns the queue. Finalised frames and frames that are no longer in their recording are left out.

    Args:
        label: only proposals of this class; ignored by TEACH.
        most: number of items to return; None = all.
        attribute: only proposals with these values of an attribute; ignored by TEACH.
        source: only proposals of objects that this source sees; ignored by TEACH.
    """
    if order is Order.TEACH:
        items = _to_teach(project)
        return Queue(tuple(items[:most]), len(items))
    classes = None if label is None else [label]
    found, total = waiting(
        project.store,
        _BY[order],
        classes=classes,
        attribute=attribute,
        source=source,
        most=most,
    )
    return Queue(found, total)


def _to_teach(project: Project) -> list[QueueItem]:
    present = [frame for frame in project.frames.of() if frame.index is not None]
    frames = {frame.id: frame for frame in present if not frame.finalised}
    known = project.boxes.frames_with_images() | project.labels.frames(states=REVIEWED)
    worst = worst_of_frames(project.store, None)
    untouched = [frame for frame in frames.values() if frame.id not in known and frame.id not in worst]
    seen = [frame for frame in present if frame.id in known]
    ordered = [QueueItem(frame, None, None, None) for frame in _spread(untouched, seen)]
    doubtful = sorted((frame_id for frame_id in worst if frame_id in frames), key=lambda frame_id: -worst[frame_id])
    proposed = [QueueItem(frames[frame_id], None, None, worst[frame_id]) for frame_id in doubtful]
    # doubtful proposals help training most, frames without proposals less, certain proposals least
    certain = sum(worst[item.frame.id] < 0.5 for item in proposed)
    return [*proposed[: len(proposed) - certain], *ordered, *proposed[len(proposed) - certain :]]


def _spread(frames: Sequence[StoredFrame], seen: Sequence[StoredFrame]) -> list[StoredFrame]:
    """Orders frames so that each comes from the widest remaining gap of its recording, since neighbours look alike.

    The recordings take turns.
    """
    labelled: dict[int, list[int]] = defaultdict(list)
    for frame in seen:
        labelled[frame.recording_id].append(frame.index or 0)
    by_recording: dict[int, list[StoredFrame]] = defaultdict(list)
    for frame in frames:
        by_recording[frame.recording_id].append(frame)
    orders = [
        _widest_first(sorted(group, key=lambda frame: frame.index or 0), sorted(labelled[recording]))
        for recording, group in by_recording.items()
    ]
    return [frame for turn in zip_longest(*orders) for frame in turn if frame is not None]


def _widest_first(frames: Sequence[StoredFrame], labelled: Sequence[int]) -> list[StoredFrame]:
    """Orders the frames of one recording.

    Args:
        frames: in the order of the recording.
        labelled: indices of its labelled frames, ascending.
    """
    halving = _halving(0, len(frames) - 1)
    if labelled:
        # a stable sort: frames at equal distance stay in halving order, and distances that differ little are equal
        halving.sort(key=lambda number: -_distance(frames[number].index or 0, labelled).bit_length())
    # without labelled frames, the queue starts at the first frame
    return [frames[number] for number in halving]


def _distance(index: int, labelled: Sequence[int]) -> int:
    """Returns the distance to the nearest labelled frame; `labelled` is ascending and not empty."""
    behind = bisect_left(labelled, index)
    return min(abs(index - other) for other in labelled[max(behind - 1, 0) : behind + 1])


def _halving(first: int, last: int) -> list[int]:
    """Returns all integers of a range: both ends, the middle, the middles of the remaining gaps, and so on."""
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
