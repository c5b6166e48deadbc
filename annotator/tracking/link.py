"""Linking of boxes into tracks: frame by frame, by the assignment of least cost (Kuhn-Munkres).

The cost of a box for a track depends on its distance from the track's predicted box, and on their overlap and
difference in size. Boxes that are out of reach are never assigned. Ids from operators or files take precedence
over costs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64
from scipy.optimize import linear_sum_assignment

from annotator.geometry.iou import iou_3d_matrix
from annotator.geometry.oriented_box import contains
from annotator.types import OrientedBox

# Lengths are shares of an object's longest side, times are in frames (`frame_times`).
# Maximum distance from the expected position, per frame; the same for an object with only one box, whose motion is
# unknown; number of missed frames over which the distance grows at most.
REACH, REACH_NEW, MOST_FRAMES = 0.5, 1.0, 3.0
# A track ends after so many missed frames.
MAX_GAP = 5.0
# Maximum ratio between a side of two boxes of one object.
MAX_SIZE_RATIO = 2.5
# Number of last boxes from which the motion is estimated.
MOTION_BOXES = 4


def frame_times(times_ns: Sequence[int | None]) -> Float64[np.ndarray, "n"]:
    """The times of a recording's frames in units of the median interval between frames, from 0.

    Args:
        times_ns: in order. If one is unknown, or they do not increase, equal intervals are assumed.
    """
    count = np.arange(len(times_ns), dtype=np.float64)
    if len(times_ns) < 2 or any(time is None for time in times_ns):
        return count
    first = times_ns[0]
    # differences first, since float64 cannot represent nanoseconds since the epoch
    passed = np.array([float(time - first) for time in times_ns if time is not None and first is not None])
    steps = np.diff(passed)
    return count if (steps <= 0).any() else passed / np.median(steps)


def predicted(boxes: Sequence[OrientedBox], times: Sequence[float], time: float) -> OrientedBox:
    """An object's last box, moved to its predicted position at `time`.

    Args:
        boxes: one or more boxes of the object, in order of time; a line is fitted to their centres.
    """
    last = boxes[-1]
    passed = np.asarray(times) - np.mean(times)
    if not passed.any():
        return last
    centers = np.array([box.center_m for box in boxes])
    velocity = passed @ (centers - centers.mean(axis=0)) / (passed @ passed)
    center = last.center_m + velocity * (time - times[-1])
    return OrientedBox.from_parts(center, last.rotation, last.size_m)


# Minimum exact 3D IoU; a box that was drawn by hand and one that was followed may differ much.
SAME_PLACE_IOU = 0.3


def overlap_at_place(first: Sequence[OrientedBox], second: Sequence[OrientedBox]) -> Float64[np.ndarray, "n m"]:
    """The exact 3D IoU of the pairs of boxes that stand at the same place; 0 for all others.

    Two boxes do if their IoU is 0.3 or more, or if each contains the other's centre: the IoU of a long box with itself
    is small after a turn.
    """
    if not first or not second:
        return np.zeros((len(first), len(second)))
    centers = [np.array([box.center_m for box in boxes]) for boxes in (first, second)]
    reach = [np.linalg.norm([box.size_m for box in boxes], axis=1) / 2 for boxes in (first, second)]
    apart = np.linalg.norm(centers[0][:, None] - centers[1][None], axis=2)
    if (apart > reach[0][:, None] + reach[1][None]).all():
        return np.zeros(apart.shape)
    iou = np.maximum(iou_3d_matrix(first, second), np.finfo(np.float64).tiny)
    holds_second = np.array([contains(box, centers[1]) for box in first])
    holds_first = np.array([contains(box, centers[0]) for box in second])
    return np.where((iou >= SAME_PLACE_IOU) | (holds_second & holds_first.T), iou, 0.0)


# The cost of a box that is out of reach; far above all other costs.
NEVER = 1e6


@dataclass(frozen=True, eq=False)
class Seen:
    """One box of one frame.

    Attributes:
        label: class name; only boxes of one class are linked.
        box: in one frame for all; a camera whose frame it is must be static, or move uniformly.
        given: track id from an operator or a file, or None.
    """

    label: str
    box: OrientedBox
    given: int | None = None


@dataclass(eq=False)
class Track:
    """The track of one object.

    Attributes:
        members: index of the frame, and of the box within the frame, in order of time.
        given: track id of one of the boxes from an operator or a file, or None.
    """

    label: str
    members: list[tuple[int, int]] = field(default_factory=list)
    boxes: list[OrientedBox] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    given: int | None = None


def link(frames: Sequence[Sequence[Seen]], times: Sequence[float]) -> list[Track]:
    """The tracks of a recording, in the order of their first boxes; every box belongs to one track.

    Args:
        frames: the boxes of each frame, in order of time.
        times: times of the frames, from `frame_times`.
    """
    tracks: list[Track] = []
    alive: list[Track] = []
    named: dict[tuple[str, int], Track] = {}
    for frame_index, (boxes, time) in enumerate(zip(frames, times, strict=True)):
        alive = [track for track in alive if time - track.times[-1] <= MAX_GAP + 1]
        owner = {
            number: named[seen.label, seen.given]
            for number, seen in enumerate(boxes)
            if seen.given is not None and (seen.label, seen.given) in named
        }
        free = [number for number in range(len(boxes)) if number not in owner]
        assigned_tracks = {id(track) for track in owner.values()}
        owner |= _assigned(free, boxes, [track for track in alive if id(track) not in assigned_tracks], time)
        for number, seen in enumerate(boxes):
            key = None if seen.given is None else (seen.label, seen.given)
            # two boxes with the same given id in one frame belong to one track
            track = owner.get(number) or (named.get(key) if key else None)
            if track is None:
                track = Track(seen.label)
                tracks.append(track)
            owner[number] = track
            track.members.append((frame_index, number))
            track.boxes.append(seen.box)
            track.times.append(time)
            if key is not None:
                track.given = seen.given
                named[key] = track
        alive = list({id(track): track for track in [*alive, *owner.values()]}.values())
    return tracks


def _assigned(free: Sequence[int], boxes: Sequence[Seen], waiting: Sequence[Track], time: float) -> dict[int, Track]:
    """The tracks of boxes without a given id; boxes of new objects are left out."""
    assigned: dict[int, Track] = {}
    for label in sorted({boxes[number].label for number in free}):
        numbers = [number for number in free if boxes[number].label == label]
        tracks = [track for track in waiting if track.label == label]
        if not tracks:
            continue
        cost = _costs(tracks, [boxes[number] for number in numbers], time)
        for row, column in zip(*linear_sum_assignment(cost), strict=True):
            if cost[row, column] < NEVER:
                assigned[numbers[column]] = tracks[row]
    return assigned


def _costs(tracks: Sequence[Track], seen: Sequence[Seen], time: float) -> Float64[np.ndarray, "t n"]:
    """The cost of each box for each track: at most 1 each for distance, overlap and size; `NEVER` out of reach."""
    boxes = [each.box for each in seen]
    expected = [predicted(track.boxes[-MOTION_BOXES:], track.times[-MOTION_BOXES:], time) for track in tracks]
    sides = np.array([box.size_m.max() for box in expected])
    waited = np.minimum([time - track.times[-1] for track in tracks], MOST_FRAMES)
    reach = np.array([REACH_NEW if len(track.boxes) == 1 else REACH for track in tracks])
    centers, found = (np.array([box.center_m for box in each]) for each in (expected, boxes))
    far = np.linalg.norm(centers[:, None] - found[None], axis=2) / (reach * sides * waited)[:, None]
    # the largest absolute logarithm of the ratios of sides, in the order of their lengths
    own, other = (np.log(np.sort([box.size_m for box in each], axis=1)) for each in (expected, boxes))
    unlike = np.abs(own[:, None] - other[None]).max(axis=2) / np.log(MAX_SIZE_RATIO)
    cost: Float64[np.ndarray, "t n"] = far + unlike + 1.0 - iou_3d_matrix(expected, boxes)
    # two different given ids are two objects
    named = np.array(
        [[t.given is not None and b.given is not None and t.given != b.given for b in seen] for t in tracks]
    )
    cost[(far > 1) | (unlike > 1) | named] = NEVER
    return cost


def numbered(given: Sequence[int | None], before: Sequence[Sequence[int]]) -> list[int]:
    """An id for each track, for those of its boxes that have none from an operator or a file; all are unique.

    So a box never gets the given id of another object, which may be in the same frame.

    Args:
        given: the id of each track from an operator or a file, or None. One that several tracks have, such as a
            person and a chair, is the id of neither.
        before: the ids of each track's boxes from an earlier linking. A track reuses its most frequent id. If
            several tracks compete for an id, the one with the most boxes of this id gets it.
    """
    used = {number for number in given if number is not None}
    times = Counter(given)
    given = [None if times[number] > 1 else number for number in given]
    candidates = [
        (count, -place, number)
        for place, numbers in enumerate(before)
        if given[place] is None
        for number, count in Counter(numbers).items()
    ]
    ids: dict[int, int] = {}
    for _, negative_place, number in sorted(candidates, reverse=True):
        if -negative_place not in ids and number not in used:
            ids[-negative_place] = number
            used.add(number)
    fresh = max([0, *used])
    for place, given_id in enumerate(given):
        if given_id is not None:
            ids[place] = given_id
        elif place not in ids:
            fresh += 1
            ids[place] = fresh
    return [ids[place] for place in range(len(given))]
