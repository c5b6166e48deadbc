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
    order = np.lexsort((-scores, groups))
    kept = [np.empty(0, np.int64)]
    # All groups take a step together: the best box left of each stays, and what it beats goes. So there are as many
    # steps as the fullest group keeps boxes, however many pictures the batch has.
    while len(order):
        group = groups[order]
        begins = np.concatenate([[True], group[1:] != group[:-1]])
        best = order[begins]
        kept.append(best)
        beaten = _ious(boxes[best[np.cumsum(begins) - 1]], boxes[order]) > iou
        order = order[~(begins | beaten)]
    found = np.concatenate(kept)
    return found[np.lexsort((found, -scores[found]))]


def _ious(a: Float[np.ndarray, "n 4"], b: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n"]:
    """Of each box with the one in the same row."""
    low = np.maximum(a[:, :2], b[:, :2])
    high = np.minimum(a[:, 2:], b[:, 2:])
    shared = np.prod(np.clip(high - low, 0, None), axis=1)
    union = np.prod(a[:, 2:] - a[:, :2], axis=1) + np.prod(b[:, 2:] - b[:, :2], axis=1) - shared
    return shared / np.maximum(union, 1e-12)
