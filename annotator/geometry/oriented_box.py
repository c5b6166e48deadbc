"""Oriented boxes: corners, points inside, the box around points, and a canonical order of axes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float64

from annotator.types import OrientedBox
from annotator.types.errors import GeometryError

# Minimum side of a box around points, so that points on a plane still give a valid box.
MIN_SIDE_M = 1e-3
# Tolerance for equal boxes: metres, and entries of the rotation matrix.
SAME_BOX = 1e-6

# Order of the corners, along the box's own x, y, z: --- +-- ++- -+- --+ +-+ +++ -++
CORNER_SIGNS = np.array(
    [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], np.float64
)
CORNER_SIGNS.flags.writeable = False

# The 12 edges as pairs of corner indices: around the bottom, around the top, and the four vertical ones.
EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))

# The arrow of the heading ends so far in front of the box, share of its mean side. As in web_assets/js/box3d.js.
ARROW_BEYOND = 0.2


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


def heading_arrow(box: OrientedBox) -> Float64[np.ndarray, "2 3"]:
    """The arrow that shows a box's heading: from its centre through its front (+x) face; camera frame, metres."""
    reach_m = 0.5 * box.size_m[0] + ARROW_BEYOND * box.size_m.mean()
    return np.stack([box.center_m, box.center_m + reach_m * box.rotation[:, 0]])


def contains_parts(
    center: Float[np.ndarray, "3"],
    rotation: Float[np.ndarray, "3 3"],
    size: Float[np.ndarray, "3"],
    xyz: Float[np.ndarray, "n 3"],
) -> Bool[np.ndarray, "n"]:
    """Which points lie in a box or on its surface; NaN points are outside.

    The computation uses the precision of `xyz`, after subtracting the centre.

    Args:
        center, rotation, size: as in `corners`.
        xyz: points in the same frame, metres.
    """
    from annotator.geometry.kernels import points_in_box

    dtype = xyz.dtype
    half = (0.5 * size).astype(dtype)
    return points_in_box(np.ascontiguousarray(xyz), center.astype(dtype), rotation.astype(dtype, "C"), half)


def contains(box: OrientedBox, xyz_m: Float[np.ndarray, "n 3"], margin_m: float = 0.0) -> Bool[np.ndarray, "n"]:
    """Which points (camera frame) lie in a box with all faces moved outwards by `margin_m` metres.

    A negative margin shrinks the box; a box that is shrunk to nothing contains no points.
    """
    return contains_parts(box.center_m, box.rotation, box.size_m + 2.0 * margin_m, xyz_m)


def aligned_box(xyz_m: Float[np.ndarray, "n 3"], rotation: Float[np.ndarray, "3 3"]) -> OrientedBox:
    """The smallest box with given axes around points.

    Args:
        xyz_m: at least one point, metres.
        rotation: columns = box axes in the frame of the points.

    Returns:
        the box; shorter sides are widened to `MIN_SIDE_M`.

    Raises:
        GeometryError: no points, or points that are not finite.
        ValueError: `rotation` is not a rotation.
    """
    if len(xyz_m) == 0:
        raise GeometryError("a box needs at least 1 point, not 0")
    if not np.isfinite(xyz_m).all():
        raise GeometryError("a box needs finite points; drop the invalid ones first")
    xyz = np.asarray(xyz_m, np.float64)
    axes = np.asarray(rotation, np.float64)
    # differences between points are more precise than the coordinates themselves
    local = (xyz - xyz[0]) @ axes
    low, high = local.min(axis=0), local.max(axis=0)
    center = xyz[0] + axes @ (0.5 * (low + high))
    return OrientedBox.from_parts(center, axes, np.maximum(high - low, MIN_SIDE_M))


def canonical_box(box: OrientedBox, up: Float64[np.ndarray, "3"] | None) -> OrientedBox:
    """The same box with one unique labelling of its axes; 24 labellings describe the same box.

    With `up` (unit vector), z points up and length >= width; otherwise length >= width >= height. Among the remaining
    labellings, the one whose axes point away from the camera and to its right is chosen.
    """
    rotation, size = box.rotation, box.size_m
    if up is not None:
        vertical = int(np.argmax(np.abs(up @ rotation)))
        level = [i for i in range(3) if i != vertical]
        order = [*sorted(level, key=lambda i: -size[i]), vertical]
    else:
        order = list(np.argsort(-size, kind="stable"))
    axes = rotation[:, order].copy()
    if up is not None:
        axes[:, 2] *= np.sign(axes[:, 2] @ up)
    elif axes[:, 2] @ np.array([0.3, 0.1, 1.0]) < 0:
        axes[:, 2] *= -1
    if axes[:, 0] @ np.array([1.0, 0.1, 0.3]) < 0:
        axes[:, 0] *= -1
    # z cross x; np.cross takes longer than the rest of the function
    (a, b, c), (d, e, f) = axes[:, 2].tolist(), axes[:, 0].tolist()
    axes[:, 1] = (b * f - c * e, c * d - a * f, a * e - b * d)
    return OrientedBox.from_parts(box.center_m, axes, size[order])


def same_box(a: OrientedBox, b: OrientedBox) -> bool:
    """True if two boxes have the same centre, axes and size, within `SAME_BOX`."""
    return bool(
        np.allclose(a.pose, b.pose, rtol=0, atol=SAME_BOX) and np.allclose(a.size_m, b.size_m, rtol=0, atol=SAME_BOX)
    )
