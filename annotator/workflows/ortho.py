"""Three pictures of a 3D box along its own axes: top, front and side, in which its edges can be moved and it can be
turned. What lies around the box is shown dimmed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64, UInt8

from annotator.geometry.oriented_box import contains
from annotator.rcv.drawing import BACKGROUND, Window, draw_views, pack_colors
from annotator.rcv.pseudo_view import point_colors
from annotator.types import OrientedBox, PointCloud, PseudoView
from annotator.workflows.open_frame import OpenFrame

# How much around the box is shown, a share of its longest side on each side of the picture, and how deep into the
# page, a share of its depth: context, but not the wall behind.
AROUND = 0.35
DEEP = 0.5
# Points outside the box keep this share of their contrast to the background.
DIMMED = 0.3
MAX_SPLAT_PX = 9
# More points in the box, and around it, are more than the picture can show.
MOST_INSIDE, MOST_AROUND = 40_000, 25_000


@dataclass(frozen=True)
class Axis:
    """One picture: its name, and which of the box's axes point right, down and into the page, each with its sign."""

    name: str
    right: tuple[int, int]
    down: tuple[int, int]
    depth: tuple[int, int]


# x length, y width, z height: heading up in the top view, height up in the others
AXES = (
    Axis("top", (1, -1), (0, -1), (2, -1)),
    Axis("front", (1, -1), (2, -1), (0, 1)),
    Axis("side", (0, 1), (2, -1), (1, 1)),
)


@dataclass(frozen=True, eq=False)
class OrthoView:
    """A picture and its name: top, front or side."""

    name: str
    view: PseudoView


def ortho_views(opened: OpenFrame, box: OrientedBox, size_px: int) -> list[OrthoView]:
    """The three pictures.

    Args:
        size_px: of each side of each picture, pixels.
    """
    cloud, is_inside = _near(opened, box)
    colors = point_colors(cloud)
    if colors is not None:
        colors = _dimmed(colors, is_inside)
    local = (cloud.xyz_m - box.center_m.astype(np.float32)) @ box.rotation.astype(np.float32)
    return [OrthoView(axis.name, _view(axis, box, cloud, local, colors, size_px)) for axis in AXES]


def _near(opened: OpenFrame, box: OrientedBox) -> tuple[PointCloud, Bool[np.ndarray, "n"]]:
    """The points that one of the pictures may show, thinned out where they are many, and which lie in the box."""
    margin = AROUND * float(box.size_m.max())
    near = opened.index.inside(replace(box, size_m=_shown(box, 2 * margin)))
    is_inside = contains(box, opened.frame.cloud.xyz_m[near])
    inside, around = _thinned(near[is_inside], MOST_INSIDE), _thinned(near[~is_inside], MOST_AROUND)
    cloud = replace(opened.frame.cloud, normals=None).select(np.concatenate([inside, around]))
    return cloud, np.arange(len(cloud)) < len(inside)


def _thinned(places: Int64[np.ndarray, "n"], most: int) -> Int64[np.ndarray, "m"]:
    return places if len(places) <= most else places[np.linspace(0, len(places) - 1, most).astype(np.int64)]


def _shown(box: OrientedBox, more_m: float) -> Float64[np.ndarray, "3"]:
    """Sides of what is shown: as wide as the pictures, which are square, or as deep as they look."""
    return np.maximum(np.full(3, float(box.size_m.max())) + more_m, box.size_m * (1 + 2 * DEEP))


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
    scale = float(sides.max() * (1 + 2 * AROUND)) / size_px
    origin = center[:2] - (size_px - 1) / 2 * scale
    along = np.stack([sign * local[:, which] for which, sign in (axis.right, axis.down, axis.depth)])
    half = (size_px - 0.5) / 2 * scale
    depth = box.size_m[axis.depth[0]]
    shown = (np.abs(along[0]) < half) & (np.abs(along[1]) < half) & (np.abs(along[2]) < depth * (0.5 + DEEP))
    picture = np.full((size_px, size_px, 3), BACKGROUND, np.uint8)
    if shown.any():
        xyz = np.ascontiguousarray(along[:, shown], np.float32)
        depths = np.array([[xyz[2].min(), xyz[2].max()]])
        window = Window(origin - center[:2], scale, size_px, size_px)
        packed = pack_colors(None if colors is None else np.ascontiguousarray(colors[shown]), int(shown.sum()))
        (picture,) = draw_views(xyz, packed, np.eye(3, dtype=np.float32)[None], [window], depths, MAX_SPLAT_PX)
    return PseudoView(picture, _right_handed(rows), scale, origin, cloud.xyz_m[shown])


def _right_handed(rows: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    """A picture's axes are right, down, into the page; the table above must say so."""
    assert np.linalg.det(rows) > 0
    return rows
