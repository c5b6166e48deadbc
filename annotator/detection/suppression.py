"""Of boxes that overlap, the better stays; for a whole batch of pictures at once.

torchvision has this too, but loading it takes as long as loading torch itself.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int64


def suppress(
    boxes: Float[np.ndarray, "n 4"],
    scores: Float[np.ndarray, "n"],
    groups: Int64[np.ndarray, "n"],
    iou: float,
) -> Int64[np.ndarray, "k"]:
    """Which boxes stay, best score first: greedy non-maximum suppression within each group.

    Args:
        boxes: x_min y_min x_max y_max.
        scores: the better of two overlapping boxes has the higher one; of equals the first.
        groups: only boxes of the same group (picture and class) suppress each other.
        iou: a box that overlaps a better one by more than this goes.
    """
    order = np.argsort(-scores, kind="stable")
    kept = []
    while len(order):
        best, order = order[0], order[1:]
        kept.append(best)
        beaten = (groups[order] == groups[best]) & (_ious(boxes[best], boxes[order]) > iou)
        order = order[~beaten]
    return np.array(kept, np.int64)


def _ious(box: Float[np.ndarray, "4"], others: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n"]:
    low = np.maximum(box[:2], others[:, :2])
    high = np.minimum(box[2:], others[:, 2:])
    shared = np.prod(np.clip(high - low, 0, None), axis=1)
    areas = np.prod(others[:, 2:] - others[:, :2], axis=1)
    union = np.prod(box[2:] - box[:2]) + areas - shared
    return shared / np.maximum(union, 1e-12)
