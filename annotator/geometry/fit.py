"""Oriented boxes around points: of least volume, of least area with a given vertical, or along given axes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import ConvexHull, QhullError

from annotator.geometry.box_search import least_volume_rotation, least_width_direction
from annotator.geometry.transforms import right_handed_frame
from annotator.types import OrientedBox
from annotator.types.errors import GeometryError

# A box has no side below this: points on a plane still make a box that can be seen and written.
MIN_SIDE_M = 1e-3

# Points whose spread in a direction is below this share of their largest spread count as flat in it. The
# coordinates are float32 in places, so a few metres from the origin a plane is no flatter than this.
FLAT = 1e-5


def aligned_box(xyz_m: Float[np.ndarray, "n 3"], rotation: Float[np.ndarray, "3 3"]) -> OrientedBox:
    """The smallest box with given axes around points.

    Args:
        xyz_m: at least one point, metres.
        rotation: columns = box axes in the frame of the points.

    Returns:
        The box; sides below `MIN_SIDE_M` are widened to it.

    Raises:
        GeometryError: no points, or points that are not finite.
        ValueError: `rotation` is not a rotation.
    """
    xyz = _finite_points(xyz_m, at_least=1)
    axes = np.asarray(rotation, np.float64)
    # the differences to one of the points are exact to more digits than the coordinates themselves
    local = (xyz - xyz[0]) @ axes
    low, high = local.min(axis=0), local.max(axis=0)
    center = xyz[0] + axes @ (0.5 * (low + high))
    return OrientedBox.from_parts(center, axes, np.maximum(high - low, MIN_SIDE_M))


def min_volume_box(xyz_m: Float[np.ndarray, "n 3"]) -> OrientedBox:
    """The oriented box of least volume around points, free in rotation.

    Its x, y, z are its longest, middle and shortest side. The search (see `box_search`) is exact where a face of
    the box lies flush with one of the hull's large faces; otherwise it ends in one of the best local minima.

    Args:
        xyz_m: at least three points that are not on one line, metres; points on a plane make a thin box.

    Raises:
        GeometryError: too few points, points that are not finite, or all on a line.
    """
    xyz = _finite_points(xyz_m, at_least=3)
    centered = xyz - xyz.mean(axis=0)
    spread, axes = np.linalg.eigh(centered.T @ centered)
    if spread[1] <= FLAT**2 * spread[2]:
        raise GeometryError(f"{len(xyz)} points on one line have no least-volume box; give points that spread")
    if spread[0] <= FLAT**2 * spread[2]:
        return _longest_side_first(aligned_box(xyz, _flat_rotation(centered, axes)))
    hull = _hull(centered)
    return _longest_side_first(aligned_box(xyz[hull.vertices], least_volume_rotation(hull, axes)))


def min_area_upright_box(xyz_m: Float[np.ndarray, "n 3"], up: Float[np.ndarray, "3"]) -> OrientedBox:
    """The upright box of least ground area around points, by rotating calipers (exact).

    Its z axis is `up`, its x the longer of the horizontal sides.

    Args:
        xyz_m: points that are not all above each other, metres; points in a vertical plane make a thin box.
        up: vector against gravity in the frame of the points; of any length.

    Raises:
        GeometryError: too few points, points that are not finite, all on one vertical line, or `up` is zero.
    """
    xyz = _finite_points(xyz_m, at_least=2)
    frame = right_handed_frame(up, np.array([1.0, 0.0, 0.0]))
    ground = (xyz - xyz.mean(axis=0)) @ frame[:, 1:]
    spread, axes = np.linalg.eigh(ground.T @ ground)
    if spread[1] <= (FLAT * np.abs(xyz).max()) ** 2:
        raise GeometryError(f"{len(xyz)} points on one vertical line have no heading; give points that spread")
    flat = spread[0] <= FLAT**2 * spread[1]
    along = axes[:, 1] if flat else least_width_direction(ground[_hull(ground).vertices])
    x = frame[:, 1:] @ along
    box = aligned_box(xyz, np.stack([x, np.cross(frame[:, 0], x), frame[:, 0]], axis=1))
    if box.size_m[0] >= box.size_m[1]:
        return box
    quarter_turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return OrientedBox.from_parts(box.center_m, box.rotation @ quarter_turn, box.size_m[[1, 0, 2]])


def _finite_points(xyz_m: Float[np.ndarray, "n 3"], at_least: int) -> Float64[np.ndarray, "n 3"]:
    if len(xyz_m) < at_least:
        raise GeometryError(f"a box needs at least {at_least} points, not {len(xyz_m)}")
    if not np.isfinite(xyz_m).all():
        raise GeometryError("a box needs finite points; drop the invalid ones first")
    return np.asarray(xyz_m, np.float64)


def _hull(points: Float64[np.ndarray, "n d"]) -> ConvexHull:
    try:
        return ConvexHull(points)
    except QhullError as error:
        raise GeometryError(f"{len(points)} points have no convex hull: {str(error).splitlines()[0]}") from error


def _flat_rotation(
    centered: Float64[np.ndarray, "n 3"], axes: Float64[np.ndarray, "3 3"]
) -> Float64[np.ndarray, "3 3"]:
    """The rotation of the least box of points on a plane, whose normal is the first of `axes`."""
    in_plane = centered @ axes[:, 1:]
    x = axes[:, 1:] @ least_width_direction(in_plane[_hull(in_plane).vertices])
    return np.stack([x, np.cross(axes[:, 0], x), axes[:, 0]], axis=1)


def _longest_side_first(box: OrientedBox) -> OrientedBox:
    """The same box with its sides in falling order, its axes' signs made unique and right-handed."""
    order = np.argsort(-box.size_m, kind="stable")
    axes = box.rotation[:, order]
    axes = axes * np.sign(axes[np.argmax(np.abs(axes), axis=0), range(3)])
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return OrientedBox.from_parts(box.center_m, axes, box.size_m[order])
