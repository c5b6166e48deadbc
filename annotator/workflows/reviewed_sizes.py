"""Typical sizes of a project's classes, from its reviewed boxes."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import permutations

import numpy as np
from jaxtyping import Float64

from annotator.project import Project
from annotator.project.config import BoxRotation
from annotator.project.labels import ReviewedBox
from annotator.rcv.config import TypicalSize, typical_size
from annotator.types import OrientedBox

# Number of the latest reviewed boxes of a class that are read, and of those that count: one for each track.
MOST_READ, MOST_BOXES = 300, 60
# Before any box is reviewed: spread of a class that is not well known, the number of boxes that this guess (or the one
# of a well-known class) is worth, and the number that the mean of a well-known class is worth.
SPREAD, WORTH, MEAN_WORTH = 0.2, 2, 1
# A well-known class whose reviewed boxes deviate by more spreads on average is another one of the same name.
FOREIGN = 3.0
# A class of exactly equal boxes still has this spread.
LEAST_SPREAD = 0.03
# How much nearer (mean logarithm of a side) another order of the sides must be to the typical one.
REORDERED = 0.1


def reviewed_sizes(project: Project, without_frames: Collection[int] = ()) -> tuple[TypicalSize, ...]:
    """The typical size of each class with reviewed boxes.

    Args:
        without_frames: ids of frames whose boxes do not count.
    """
    sizes = []
    for label in project.config.classes:
        reviewed = project.labels.recent_boxes(MOST_READ, label=label)
        boxes = list(_of_each_track(item for item in reviewed if item.frame_id not in without_frames))[:MOST_BOXES]
        if boxes:
            sizes.append(_typical(label, boxes, project.config.settings.rotation))
    return tuple(sizes)


def _of_each_track(reviewed: Iterator[ReviewedBox]) -> Iterator[OrientedBox]:
    """The latest box of each track, and all boxes without one."""
    known: set[tuple[int, int]] = set()
    for item in reviewed:
        if item.track_id is not None:
            if (track := (item.recording_id, item.track_id)) in known:
                continue
            known.add(track)
        yield item.box


def _typical(label: str, boxes: list[OrientedBox], rotation: BoxRotation) -> TypicalSize:
    """Mean and spread of the logarithms of the sides, together with what is known of a class of this name."""
    logs = np.log(np.stack([box.size_m for box in boxes]))
    known = typical_size(label)
    if known is not None:
        ordered = _ordered(logs, np.log(known.size_m), rotation)
        if np.abs((ordered.mean(axis=0) - np.log(known.size_m)) / known.spread).mean() > FOREIGN:
            known = None
    if known is None:
        # the longer of the interchangeable sides first
        free = 3 if rotation is BoxRotation.FREE else 2
        first = np.concatenate([-np.sort(-logs[0, :free]), logs[0, free:]])
        ordered = _ordered(logs, first, rotation)
        mean, spread = ordered.mean(axis=0), np.full(3, SPREAD)
    else:
        mean = (ordered.sum(axis=0) + MEAN_WORTH * np.log(known.size_m)) / (len(boxes) + MEAN_WORTH)
        spread = np.array(known.spread)
    squares = ((ordered - mean) ** 2).sum(axis=0)
    spread = np.clip(np.sqrt((WORTH * spread**2 + squares) / (WORTH + len(boxes))), LEAST_SPREAD, 2.0)
    length, width, height = np.exp(mean).tolist()
    a, b, c = spread.tolist()
    return TypicalSize(label=label, size_m=(length, width, height), spread=(a, b, c))


def _ordered(
    logs: Float64[np.ndarray, "k 3"], like: Float64[np.ndarray, "3"], rotation: BoxRotation
) -> Float64[np.ndarray, "k 3"]:
    """The sides of each box in the order in which they are most like the given ones.

    The third axis of an upright box is its height, and that of other boxes any side; which boxes are upright is only
    known in projects whose rotation is set. So the height is only exchanged if that is clearly more alike.
    """
    orders: list[tuple[int, ...]] = [(0, 1, 2), (1, 0, 2)]
    if rotation is not BoxRotation.UPRIGHT:
        orders += [order for order in permutations(range(3)) if order not in orders]
    candidates = np.stack([logs[:, list(order)] for order in orders], axis=1)
    extra = np.array([0.0 if order[2] == 2 or rotation is BoxRotation.FREE else REORDERED for order in orders])
    best = (np.abs(candidates - like).mean(axis=2) + extra).argmin(axis=1)
    return np.asarray(candidates[np.arange(len(logs)), best])
