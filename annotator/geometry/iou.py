"""Exact 3D IoU of oriented boxes (compiled: `kernels`).

Two boxes are six slabs (pairs of parallel planes). Each edge of the intersection lies on the line where planes of
two slabs meet, between the points where this line enters and leaves the four other slabs. 15 pairs of slabs with 4
pairs of planes each give 60 such lines. The divergence theorem, applied twice, turns the volume into a sum over them:

    V = 1/3 sum_faces d_i A_i,   A_i = 1/2 sum_edges e_ij L_ij,   e_ij = (d_j - c_ij d_i) / s_ij

where d is a plane's distance from the origin along its outward normal, c and s are the cosine and sine of the angle
between two normals, and L_ij is the length of the line inside the slabs. No face polygons are built, and the steps
are the same for every pair of boxes.

Nearly coplanar faces are critical. The point where three planes meet is computed once and used for all three lines, so
that the lines of two nearly parallel planes end and begin at exactly the same point. Coinciding edges could still be
counted twice or not at all. So axes that are parallel up to rounding are made exactly parallel, and one of the boxes is
enlarged by a share (`TIE`) that is far above the rounding error and far below the stated accuracy.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float64, Int

from annotator.types import Box2D, OrientedBox
from annotator.types.errors import GeometryError

Vectors = Float[np.ndarray, "n 3"]
Rotations = Float[np.ndarray, "n 3 3"]


def iou_3d(a: OrientedBox, b: OrientedBox) -> float:
    """Exact intersection over union of two oriented boxes in the same frame, in 0..1."""
    parts = [values[None] for box in (a, b) for values in (box.center_m, box.rotation, box.size_m)]
    volume = float(intersection_volume_pairs(*parts)[0])
    return min(volume / (a.volume_m3 + b.volume_m3 - volume), 1.0)


def iou_3d_matrix(boxes_a: Sequence[OrientedBox], boxes_b: Sequence[OrientedBox]) -> Float64[np.ndarray, "n m"]:
    """Exact IoU of every box of one list with every box of the other.

    Pairs whose circumscribed spheres do not intersect are skipped.
    """
    (centers_a, rotations_a, sizes_a), (centers_b, rotations_b, sizes_b) = _stacked(boxes_a), _stacked(boxes_b)
    apart = np.linalg.norm(centers_a[:, None] - centers_b[None], axis=2)
    reach = 0.5 * (np.linalg.norm(sizes_a, axis=1)[:, None] + np.linalg.norm(sizes_b, axis=1)[None])
    rows, columns = np.nonzero(apart <= reach)
    a, b = (
        (centers_a[rows], rotations_a[rows], sizes_a[rows]),
        (centers_b[columns], rotations_b[columns], sizes_b[columns]),
    )
    volume = intersection_volume_pairs(*a, *b)
    matrix = np.zeros((len(boxes_a), len(boxes_b)))
    matrix[rows, columns] = np.minimum(volume / (a[2].prod(axis=1) + b[2].prod(axis=1) - volume), 1.0)
    return matrix


def intersection_volume_pairs(
    centers_a: Vectors,
    rotations_a: Rotations,
    sizes_a: Vectors,
    centers_b: Vectors,
    rotations_b: Rotations,
    sizes_b: Vectors,
) -> Float64[np.ndarray, "n"]:
    """The intersection volume of boxes a and b, for each of n pairs, m^3, between 0 and that of the smaller box.

    Centres are metres in one frame, the columns of the rotations box axes in it, sizes full lengths along them.

    Raises:
        GeometryError: a size that is not positive, or a value that is not finite.
    """
    from annotator.geometry.kernels import intersection_volumes

    boxes_a = _checked(centers_a, rotations_a, sizes_a)
    boxes_b = _checked(centers_b, rotations_b, sizes_b)
    return intersection_volumes(*boxes_a, *boxes_b)


def _checked(centers: Vectors, rotations: Rotations, sizes: Vectors) -> list[np.ndarray]:
    boxes = [np.array(values, np.float64, order="C") for values in (centers, rotations, sizes)]
    if not all(np.isfinite(values).all() for values in boxes) or (boxes[2] <= 0).any():
        raise GeometryError("boxes need finite poses and finite, positive sizes")
    return boxes


def _stacked(
    boxes: Sequence[OrientedBox],
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3 3"], Float64[np.ndarray, "n 3"]]:
    """Centres, rotations and sizes of boxes."""
    return (
        np.array([box.center_m for box in boxes]).reshape(-1, 3),
        np.array([box.rotation for box in boxes]).reshape(-1, 3, 3),
        np.array([box.size_m for box in boxes]).reshape(-1, 3),
    )


def box_iou(a: Box2D, b: Box2D) -> float:
    """IoU of two axis-aligned boxes."""
    width = min(a.x_max, b.x_max) - max(a.x_min, b.x_min)
    height = min(a.y_max, b.y_max) - max(a.y_min, b.y_min)
    if width <= 0 or height <= 0:
        return 0.0
    shared = width * height
    return shared / (a.width_px * a.height_px + b.width_px * b.height_px - shared)


def nms_3d(
    boxes: Sequence[OrientedBox], scores: Float[np.ndarray, "n"], labels: Sequence[str], iou_threshold: float
) -> Int[np.ndarray, "kept"]:
    """Greedy non-maximum suppression within each class, by exact 3D IoU.

    Boxes are processed in order of descending score. A box is dropped if its IoU with a kept box of its class is larger
    than `iou_threshold`. Of equal scores, the lower index comes first, so the result is deterministic. Scores
    are any finite numbers, the threshold is in 0..1.

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
    classes = np.asarray(labels, dtype=np.str_)
    suppresses = (iou_3d_matrix(boxes, boxes) > iou_threshold) & (classes[:, None] == classes)
    kept: list[int] = []
    for index in order.tolist():
        if not suppresses[kept, index].any():
            kept.append(index)
    return np.array(kept, np.int64)
