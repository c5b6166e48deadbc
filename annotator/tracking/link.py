"""Linking of boxes into tracks: frame by frame, by the assignment of least cost (Kuhn-Munkres).

The cost of a box for a track depends on its distance from the track's predicted box, and on their overlap and
difference in size. Boxes that are out of reach are never assigned. Ids from operators or files take precedence
over costs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64
from scipy.optimize import linear_sum_assignment

from annotator.geometry.iou import iou_3d_matrix
from annotator.tracking.config import TrackingConfig
from annotator.tracking.motion import predicted
from annotator.types import OrientedBox

# The cost of a box that is out of reach; far above all other costs.
NEVER = 1e6


@dataclass(frozen=True, eq=False)
class Seen:
    """One box of one frame.

    Attributes:
        label: class name; only boxes of one class are linked.
        box: camera frame; the camera is assumed to be static or to move uniformly.
        given: track id from an operator or a file, or None.
    """

    label: str
    box: OrientedBox
    given: int | None = None


@dataclass(eq=False)
class Track:
    """The track of one object.

    Attributes:
        label: class name.
        members: index of the frame, and of the box within the frame, in order of time.
        boxes, times: boxes and times of the members.
        given: track id of one of the boxes from an operator or a file, or None.
    """

    label: str
    members: list[tuple[int, int]] = field(default_factory=list)
    boxes: list[OrientedBox] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    given: int | None = None


def link(frames: Sequence[Sequence[Seen]], times: Sequence[float], config: TrackingConfig) -> list[Track]:
    """The tracks of a recording, in the order of their first boxes; every box belongs to one track.

    Args:
        frames: the boxes of each frame, in order of time.
        times: times of the frames, from `frame_times`.
    """
    tracks: list[Track] = []
    alive: list[Track] = []
    named: dict[tuple[str, int], Track] = {}
    for frame_index, (boxes, time) in enumerate(zip(frames, times, strict=True)):
        alive = [track for track in alive if time - track.times[-1] <= config.max_gap + 1]
        owner = {
            number: named[seen.label, seen.given]
            for number, seen in enumerate(boxes)
            if seen.given is not None and (seen.label, seen.given) in named
        }
        free = [number for number in range(len(boxes)) if number not in owner]
        assigned_tracks = {id(track) for track in owner.values()}
        owner |= _assigned(free, boxes, [track for track in alive if id(track) not in assigned_tracks], time, config)
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


def _assigned(
    free: Sequence[int], boxes: Sequence[Seen], waiting: Sequence[Track], time: float, config: TrackingConfig
) -> dict[int, Track]:
    """The tracks of boxes without a given id; boxes of new objects are left out."""
    assigned: dict[int, Track] = {}
    for label in sorted({boxes[number].label for number in free}):
        numbers = [number for number in free if boxes[number].label == label]
        tracks = [track for track in waiting if track.label == label]
        if not tracks:
            continue
        cost = _costs(tracks, [boxes[number] for number in numbers], time, config)
        for row, column in zip(*linear_sum_assignment(cost), strict=True):
            if cost[row, column] < NEVER:
                assigned[numbers[column]] = tracks[row]
    return assigned


def _costs(
    tracks: Sequence[Track], boxes: Sequence[Seen], time: float, config: TrackingConfig
) -> Float64[np.ndarray, "t n"]:
    """The cost of each box for each track: at most 1 each for distance, overlap and size; `NEVER` out of reach."""
    count = config.motion_boxes
    expected = [predicted(track.boxes[-count:], track.times[-count:], time) for track in tracks]
    sides = np.array([box.size_m.max() for box in expected])
    waited = np.minimum([time - track.times[-1] for track in tracks], config.most_frames)
    reach = np.array([config.reach_new if len(track.boxes) == 1 else config.reach for track in tracks])
    far = np.linalg.norm(_centers(expected)[:, None] - _centers([seen.box for seen in boxes])[None], axis=2)
    far /= (reach * sides * waited)[:, None]
    unlike = _unlike(expected, [seen.box for seen in boxes]) / np.log(config.max_size_ratio)
    cost = far + unlike + 1.0 - iou_3d_matrix(expected, [seen.box for seen in boxes])
    # two different given ids are two objects
    named = np.array(
        [[t.given is not None and b.given is not None and t.given != b.given for b in boxes] for t in tracks]
    )
    cost[(far > 1) | (unlike > 1) | named] = NEVER
    return cost


def _centers(boxes: Sequence[OrientedBox]) -> Float64[np.ndarray, "n 3"]:
    return np.array([box.center_m for box in boxes])


def _unlike(first: Sequence[OrientedBox], second: Sequence[OrientedBox]) -> Float64[np.ndarray, "t n"]:
    """The largest absolute logarithm of the ratios of sides; sides are compared in the order of their lengths."""
    a, b = (np.log(np.sort([box.size_m for box in boxes], axis=1)) for boxes in (first, second))
    return np.abs(a[:, None] - b[None]).max(axis=2)
