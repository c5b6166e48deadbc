"""Corners of oriented boxes, and which points lie inside."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float64

from annotator.types import OrientedBox

# Order of the corners, along the box's own x, y, z: --- +-- ++- -+- --+ +-+ +++ -++
CORNER_SIGNS = np.array(
    [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], np.float64
)
CORNER_SIGNS.flags.writeable = False

# The 12 edges as pairs of corner numbers: around the bottom, around the top, the four uprights.
EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))


def corners(
    center: Float[np.ndarray, "*n 3"], rotation: Float[np.ndarray, "*n 3 3"], size: Float[np.ndarray, "*n 3"]
) -> Float64[np.ndarray, "*n 8 3"]:
    """The corners of any number of boxes.

    Args:
        center: box centres, metres.
        rotation: columns = box axes in the frame of `center`.
        size: full lengths along the box axes, metres.

    Returns:
        Corners in the order of `CORNER_SIGNS`, in the frame of `center`.
    """
    half = 0.5 * CORNER_SIGNS * np.asarray(size, np.float64)[..., None, :]
    turned = half @ np.swapaxes(np.asarray(rotation, np.float64), -1, -2)
    return turned + np.asarray(center, np.float64)[..., None, :]


def box_corners(box: OrientedBox) -> Float64[np.ndarray, "8 3"]:
    """The corners of one box in the camera frame, metres, in the order of `CORNER_SIGNS`."""
    return corners(box.center_m, box.rotation, box.size_m)


def contains_parts(
    center: Float[np.ndarray, "3"],
    rotation: Float[np.ndarray, "3 3"],
    size: Float[np.ndarray, "3"],
    xyz: Float[np.ndarray, "n 3"],
) -> Bool[np.ndarray, "n"]:
    """Which points lie in a box or on its surface.

    Computes in the precision of `xyz`, the centre taken off first; NaN points are outside.

    Args:
        center, rotation, size: as in `corners`.
        xyz: points in the same frame, metres.
    """
    from annotator.geometry.kernels.points_in_box import points_in_box

    of_points = xyz.dtype
    half = (0.5 * size).astype(of_points)
    return points_in_box(np.ascontiguousarray(xyz), center.astype(of_points), rotation.astype(of_points, "C"), half)


def contains(box: OrientedBox, xyz_m: Float[np.ndarray, "n 3"], margin_m: float = 0.0) -> Bool[np.ndarray, "n"]:
    """Which points (camera frame) lie in a box whose every face is moved outwards by `margin_m` metres.

    A negative margin shrinks the box; one that is shrunk to nothing contains nothing.
    """
    return contains_parts(box.center_m, box.rotation, box.size_m + 2.0 * margin_m, xyz_m)
