"""Overlap of oriented boxes: exact 3D IoU, and its upright and bird's-eye forms."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int

from annotator.geometry.intersection import intersection_volume_pairs
from annotator.geometry.upright_iou import iou_bev, iou_bev_matrix, iou_upright, iou_upright_matrix
from annotator.types import OrientedBox
from annotator.types.errors import GeometryError

__all__ = [
    "intersection_volume_pairs",
    "iou_3d",
    "iou_3d_chosen",
    "iou_3d_matrix",
    "iou_3d_pairs",
    "iou_bev",
    "iou_bev_matrix",
    "iou_upright",
    "iou_upright_matrix",
    "near_pairs",
]


def iou_3d(a: OrientedBox, b: OrientedBox) -> float:
    """Exact intersection over union of two oriented boxes in the same frame, in 0..1."""
    parts = [values[None] for box in (a, b) for values in (box.center_m, box.rotation, box.size_m)]
    volume = float(intersection_volume_pairs(*parts)[0])
    return min(volume / (a.volume_m3 + b.volume_m3 - volume), 1.0)


def iou_3d_pairs(boxes_a: Sequence[OrientedBox], boxes_b: Sequence[OrientedBox]) -> Float64[np.ndarray, "n"]:
    """Exact IoU of the i-th box of one list with the i-th of the other.

    Raises:
        GeometryError: the lists differ in length.
    """
    if len(boxes_a) != len(boxes_b):
        raise GeometryError(f"pairs need lists of one length, not {len(boxes_a)} and {len(boxes_b)} boxes")
    every = np.arange(len(boxes_a))
    return iou_3d_chosen(boxes_a, boxes_b, every, every)


def iou_3d_matrix(boxes_a: Sequence[OrientedBox], boxes_b: Sequence[OrientedBox]) -> Float64[np.ndarray, "n m"]:
    """Exact IoU of every box of one list with every box of the other.

    Pairs whose circumscribed spheres do not meet cost next to nothing.
    """
    matrix = np.zeros((len(boxes_a), len(boxes_b)))
    rows, columns = near_pairs(boxes_a, boxes_b)
    matrix[rows, columns] = iou_3d_chosen(boxes_a, boxes_b, rows, columns)
    return matrix


def near_pairs(
    boxes_a: Sequence[OrientedBox], boxes_b: Sequence[OrientedBox]
) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]]:
    """Indices into both lists of the pairs whose circumscribed spheres meet; all others have IoU 0."""
    (centers_a, _, sizes_a), (centers_b, _, sizes_b) = _stacked(boxes_a), _stacked(boxes_b)
    apart = np.linalg.norm(centers_a[:, None] - centers_b[None], axis=2)
    reach = 0.5 * (np.linalg.norm(sizes_a, axis=1)[:, None] + np.linalg.norm(sizes_b, axis=1)[None])
    rows, columns = np.nonzero(apart <= reach)
    return rows, columns


def iou_3d_chosen(
    boxes_a: Sequence[OrientedBox],
    boxes_b: Sequence[OrientedBox],
    rows: Int[np.ndarray, "k"],
    columns: Int[np.ndarray, "k"],
) -> Float64[np.ndarray, "k"]:
    """Exact IoU of chosen pairs, given as indices into both lists."""
    a = [values[rows] for values in _stacked(boxes_a)]
    b = [values[columns] for values in _stacked(boxes_b)]
    volume = intersection_volume_pairs(*a, *b)
    return np.minimum(volume / (a[2].prod(axis=1) + b[2].prod(axis=1) - volume), 1.0)


def _stacked(
    boxes: Sequence[OrientedBox],
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3 3"], Float64[np.ndarray, "n 3"]]:
    """Centres, rotations and sizes of boxes."""
    return (
        np.array([box.center_m for box in boxes]).reshape(-1, 3),
        np.array([box.rotation for box in boxes]).reshape(-1, 3, 3),
        np.array([box.size_m for box in boxes]).reshape(-1, 3),
    )
