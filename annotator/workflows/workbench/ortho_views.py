"""Top, front and right side of a 3D box, seen along its own axes; the operator moves its edges and turns it in them.

The object is seen from above, from its front, and from its right: a view shows the nearest points of the side that it
is named after. Points outside the box are dimmed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64, UInt8

from annotator.geometry.oriented_box import contains
from annotator.rcv.pseudo_view import BACKGROUND, Window, draw_views, pack_colors, point_colors
from annotator.types import OrientedBox, PointCloud, PseudoView
from annotator.workflows.workbench.open_frame import OpenFrame

# Margin on each side of a view, share of the box's longest side; and in front of and behind the box, share of its
# depth. Enough for context, without the wall behind.
MARGIN = 0.35
DEPTH_MARGIN = 0.5
# Points outside the box keep this share of their contrast to the background.
DIMMED = 0.3
MAX_SPLAT_PX = 9
# Larger clouds are thinned out to these numbers of points: views cannot show more.
MAX_INSIDE, MAX_AROUND = 40_000, 25_000


@dataclass(frozen=True)
class Axis:
    """The name of a view, and the box's axes that point right, down and into it: (axis, sign) each."""

    name: str
    right: tuple[int, int]
    down: tuple[int, int]
    depth: tuple[int, int]


# x length (its positive end is the front), y width (positive: left), z height. In the top view, the heading is up. In
# the others, height is up: in the front view, the object's left is on the right, as of a person who faces you; in the
# side view, which shows the right side, the heading is on the right.
AXES = (
    Axis("top", (1, -1), (0, -1), (2, -1)),
    Axis("front", (1, 1), (2, -1), (0, -1)),
    Axis("side", (0, 1), (2, -1), (1, 1)),
)


@dataclass(frozen=True, eq=False)
class OrthoView:
    """A view and its name: top, front or side (the right one)."""

    name: str
    view: PseudoView


def ortho_views(opened: OpenFrame, box: OrientedBox, size_px: int) -> list[OrthoView]:
    """Returns the top, front and side view of a box.

    Args:
        size_px: side length of each (square) view, pixels.
    """
    return views_of_points(opened.frame.cloud, opened.inside(shown_volume(box)), box, size_px)


def shown_volume(box: OrientedBox) -> OrientedBox:
    """Returns the box that encloses all points that the three views of a box may show."""
    return replace(box, size_m=_shown(box, 2 * MARGIN * float(box.size_m.max())))


def views_of_points(
    points: PointCloud, near: Int64[np.ndarray, "k"], box: OrientedBox, size_px: int
) -> list[OrthoView]:
    """As `ortho_views`.

    Args:
        near: indices of the points in `shown_volume`.
    """
    cloud, is_inside = _near(points, near, box)
    colors = point_colors(cloud)
    if colors is not None:
        colors = _dimmed(colors, is_inside)
    local = (cloud.xyz_m - box.center_m.astype(np.float32)) @ box.rotation.astype(np.float32)
    return [OrthoView(axis.name, _view(axis, box, cloud, local, colors, size_px)) for axis in AXES]


def _near(
    points: PointCloud, near: Int64[np.ndarray, "k"], box: OrientedBox
) -> tuple[PointCloud, Bool[np.ndarray, "n"]]:
    """Returns the points that the views may show, thinned out, and the mask of those in the box."""
    is_inside = contains(box, points.xyz_m[near])
    inside, around = _thinned(near[is_inside], MAX_INSIDE), _thinned(near[~is_inside], MAX_AROUND)
    cloud = replace(points, normals=None).select(np.concatenate([inside, around]))
    return cloud, np.arange(len(cloud)) < len(inside)


def _thinned(indices: Int64[np.ndarray, "n"], limit: int) -> Int64[np.ndarray, "m"]:
    return indices if len(indices) <= limit else indices[np.linspace(0, len(indices) - 1, limit).astype(np.int64)]


def _shown(box: OrientedBox, margin_m: float) -> Float64[np.ndarray, "3"]:
    """Returns the sides of the box that encloses the volumes of all three views, metres."""
    return np.maximum(np.full(3, float(box.size_m.max())) + margin_m, box.size_m * (1 + 2 * DEPTH_MARGIN))


def _dimmed(colors: UInt8[np.ndarray, "n 3"], inside: np.ndarray) -> UInt8[np.ndarray, "n 3"]:
    dim = BACKGROUND + DIMMED * (colors[~inside].astype(np.float32) - BACKGROUND)
    colors = colors.copy()
    colors[~inside] = dim.astype(np.uint8)
    return colors


def _view(
    axis: Axis,
    box: OrientedBox,
    cloud: PointCloud,
    local: Float[np.ndarray, "n 3"],
    colors: UInt8[np.ndarray, "n 3"] | None,
    size_px: int,
) -> PseudoView:
    rows = np.stack([sign * box.rotation[:, which] for which, sign in (axis.right, axis.down, axis.depth)])
    center = rows @ box.center_m
    sides = box.size_m[[axis.right[0], axis.down[0]]]
    scale = float(sides.max() * (1 + 2 * MARGIN)) / size_px
    origin = center[:2] - (size_px - 1) / 2 * scale
    along = np.stack([sign * local[:, which] for which, sign in (axis.right, axis.down, axis.depth)])
    half = (size_px - 0.5) / 2 * scale
    depth = box.size_m[axis.depth[0]]
    shown = (np.abs(along[0]) < half) & (np.abs(along[1]) < half) & (np.abs(along[2]) < depth * (0.5 + DEPTH_MARGIN))
    rgb = np.full((size_px, size_px, 3), BACKGROUND, np.uint8)
    if shown.any():
        xyz = np.ascontiguousarray(along[:, shown], np.float32)
        depths = np.array([[xyz[2].min(), xyz[2].max()]])
        window = Window(origin - center[:2], scale, size_px, size_px)
        packed = pack_colors(None if colors is None else np.ascontiguousarray(colors[shown]), int(shown.sum()))
        (rgb,) = draw_views(xyz, packed, np.eye(3, dtype=np.float32)[None], [window], depths, MAX_SPLAT_PX)
    return PseudoView(rgb, _right_handed(rows), scale, origin, cloud.xyz_m[shown])


def _right_handed(rows: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    """Asserts that right, down and into the view form a right-handed frame, as `AXES` must give."""
    assert np.linalg.det(rows) > 0
    return rows
