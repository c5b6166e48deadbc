"""Non-maximum suppression of oriented boxes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from annotator.geometry.iou import iou_3d_chosen, near_pairs
from annotator.types import OrientedBox
from annotator.types.errors import GeometryError


def nms_3d(
    boxes: Sequence[OrientedBox], scores: Float[np.ndarray, "n"], labels: Sequence[str], iou_threshold: float
) -> Int[np.ndarray, "kept"]:
    """Greedy non-maximum suppression within each class, by exact 3D IoU.

    Boxes are processed in order of descending score. A box is dropped if its IoU with a kept box of its class is larger
    than `iou_threshold`. Of equal scores, the lower index comes first, so the result is deterministic.

    Args:
        boxes: in one frame.
        scores: one per box; any finite numbers.
        labels: one class name per box.
        iou_threshold: in 0..1.

    Returns:
        Indices of the kept boxes, best score first.

    Raises:
        GeometryError: different numbers of boxes, scores and labels, or a score that is not finite.
    """
    if not len(boxes) == len(scores) == len(labels):
        raise GeometryError(
            f"each box needs one score and one label, not {len(scores)} and {len(labels)} for {len(boxes)} boxes"
        )
    if not np.isfinite(scores).all():
        raise GeometryError("scores must be finite")
    order = np.argsort(-np.asarray(scores, np.float64), kind="stable")
    overlapping = _overlapping(boxes, labels, order, iou_threshold)
    kept: list[int] = []
    for index in order.tolist():
        if not any((better, index) in overlapping for better in kept):
            kept.append(index)
    return np.array(kept, np.int64)


def _overlapping(
    boxes: Sequence[OrientedBox], labels: Sequence[str], order: np.ndarray, iou_threshold: float
) -> set[tuple[int, int]]:
    """Pairs (better, worse) of boxes of one class with an IoU above the threshold."""
    if len(boxes) < 2:
        return set()
    rank = np.argsort(order)
    classes = np.unique(np.asarray(labels, dtype=np.str_), return_inverse=True)[1].reshape(-1)
    better, worse = near_pairs(boxes, boxes)
    compare = (rank[better] < rank[worse]) & (classes[better] == classes[worse])
    better, worse = better[compare], worse[compare]
    above = iou_3d_chosen(boxes, boxes, better, worse) > iou_threshold
    return set(zip(better[above].tolist(), worse[above].tolist(), strict=True))
