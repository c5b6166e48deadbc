"""Which boxes of one moment and class stand at the same place, so that they are taken for the same object."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64

from annotator.geometry.iou import iou_3d_matrix
from annotator.types import OrientedBox

# Minimum exact 3D IoU; a box that was drawn by hand and one that was followed may differ much.
SAME_PLACE_IOU = 0.3


def overlap_at_place(first: Sequence[OrientedBox], second: Sequence[OrientedBox]) -> Float64[np.ndarray, "n m"]:
    """The exact 3D IoU of the pairs of boxes that stand at the same place; 0 for all others.

    Two boxes do if their IoU is 0.3 or more, or if each contains the other's centre: the IoU of a long box with itself
    is small after a turn.
    """
    if not first or not second:
        return np.zeros((len(first), len(second)))
    iou = np.maximum(iou_3d_matrix(first, second), np.finfo(np.float64).tiny)
    is_same = (iou >= SAME_PLACE_IOU) | (_contains_centers(first, second) & _contains_centers(second, first).T)
    return np.where(is_same, iou, 0.0)


def _contains_centers(boxes: Sequence[OrientedBox], others: Sequence[OrientedBox]) -> Bool[np.ndarray, "n m"]:
    """Which boxes contain the centres of which others."""
    centers = np.array([other.center_m for other in others])
    inside = [(np.abs((centers - box.center_m) @ box.rotation) <= box.size_m / 2).all(axis=1) for box in boxes]
    return np.array(inside)
