"""Typical sizes of a project's classes, from its reviewed boxes."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from jaxtyping import Float64

from annotator.project import REVIEWED, Project
from annotator.project.config import BoxRotation
from annotator.rcv.typical_size.sizes import TypicalSize, typical_size
from annotator.types import BoxKind, OrientedBox

# Number of the latest reviewed boxes of a class that count.
MOST_BOXES = 60
# Before any box is reviewed: spread of a class that is not well known, the number of boxes that this guess (or the one
# of a well-known class) is worth, and the number that the mean of a well-known class is worth.
SPREAD, WORTH, MEAN_WORTH = 0.2, 2, 1
# A class of exactly equal boxes still has this spread.
LEAST_SPREAD = 0.03
# Boxes whose third axes are this parallel (cosine) are upright.
PARALLEL = 0.98


def reviewed_sizes(project: Project, without_frames: Collection[int] = ()) -> tuple[TypicalSize, ...]:
    """The typical size of each class with reviewed boxes of whole objects.

    Args:
        without_frames: ids of frames whose boxes do not count.
    """
    sizes = []
    for label in project.config.classes:
        stored = project.labels.recent(label, REVIEWED, MOST_BOXES)
        boxes = [
            item.label.box
            for item in stored
            if item.frame_id not in without_frames and item.label.box_kind is BoxKind.BOX
        ]
        if boxes:
            sizes.append(_typical(label, boxes, project.config.settings.rotation))
    return tuple(sizes)


def _typical(label: str, boxes: list[OrientedBox], rotation: BoxRotation) -> TypicalSize:
    """Mean and spread of the logarithms of the sides, together with what is known of a class of this name."""
    logs = np.log(_ordered(boxes, rotation))
    known = typical_size(label)
    mean, spread = logs.mean(axis=0), np.full(3, SPREAD)
    if known is not None:
        mean = (logs.sum(axis=0) + MEAN_WORTH * np.log(known.size_m)) / (len(boxes) + MEAN_WORTH)
        spread = np.array(known.spread)
    squares = ((logs - mean) ** 2).sum(axis=0)
    spread = np.maximum(np.sqrt((WORTH * spread**2 + squares) / (WORTH + len(boxes))), LEAST_SPREAD)
    length, width, height = np.exp(mean).tolist()
    a, b, c = np.minimum(spread, 2.0).tolist()
    return TypicalSize(label=label, size_m=(length, width, height), spread=(a, b, c))


def _ordered(boxes: list[OrientedBox], rotation: BoxRotation) -> Float64[np.ndarray, "k 3"]:
    """The sides of the boxes in comparable order: of upright ones with the height last, the others by length."""
    sizes = np.stack([box.size_m for box in boxes])
    third = np.stack([box.rotation[:, 2] for box in boxes])
    is_upright = rotation is BoxRotation.UPRIGHT or bool((np.abs(third @ third[0]) >= PARALLEL).all())
    if rotation is BoxRotation.FREE or not is_upright:
        return np.asarray(-np.sort(-sizes, axis=1))
    return np.column_stack([-np.sort(-sizes[:, :2], axis=1), sizes[:, 2]])
