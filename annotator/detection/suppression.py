"""Non-maximum suppression of 2D boxes, for a whole batch at once.

torchvision also has this function, but takes as long to load as torch itself.
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
    """Greedy non-maximum suppression within each group.

    Args:
        boxes: x_min y_min x_max y_max.
        scores: of two overlapping boxes, the one with the higher score is kept, or the first if they are equal.
        groups: only boxes of the same group (image and class) suppress each other.
        iou: a box is removed if its IoU with a better box exceeds this.

    Returns:
        Indices of the kept boxes, best score first.
    """
    order = np.lexsort((-scores, groups))
    kept = [np.empty(0, np.int64)]
    # Each step handles all groups at once: it keeps the best remaining box of each group and removes the boxes that it
    # suppresses. The number of steps is the largest number of boxes kept in one group, independent of the batch size.
    while len(order):
        group = groups[order]
        begins = np.concatenate([[True], group[1:] != group[:-1]])
        best = order[begins]
        kept.append(best)
        suppressed = _ious(boxes[best[np.cumsum(begins) - 1]], boxes[order]) > iou
        order = order[~(begins | suppressed)]
    indices = np.concatenate(kept)
    return indices[np.lexsort((indices, -scores[indices]))]


def _ious(a: Float[np.ndarray, "n 4"], b: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n"]:
    """IoU of the boxes in the same row of `a` and `b`."""
    low = np.maximum(a[:, :2], b[:, :2])
    high = np.minimum(a[:, 2:], b[:, 2:])
    shared = np.prod(np.clip(high - low, 0, None), axis=1)
    union = np.prod(a[:, 2:] - a[:, :2], axis=1) + np.prod(b[:, 2:] - b[:, :2], axis=1) - shared
    return shared / np.maximum(union, 1e-12)
