"""Pseudo-views: orthographic RGB images of a cloud along given axes (RCV paper, section II.C)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64, UInt8

from annotator.geometry.thinning import thin
from annotator.rcv.config import ViewConfig
from annotator.rcv.drawing import BACKGROUND, Window, draw_views, fit_windows, pack_colors
from annotator.types import PointCloud, PseudoView


def side_axes(axes: Float64[np.ndarray, "*k 3 3"]) -> Float64[np.ndarray, "*k 3 3"]:
    """The axes (rows) of the side view that belongs to a front view with rows a1, a2, a3: a3, a2, -a1."""
    return np.stack([axes[..., 2, :], axes[..., 1, :], -axes[..., 0, :]], axis=-2)


def point_colors(cloud: PointCloud) -> UInt8[np.ndarray, "n 3"] | None:
    """The cloud's colours, or grey values of its reflectance; None without both (then it is shaded by depth)."""
    if cloud.rgb is not None:
        return cloud.rgb
    if cloud.reflectance is None:
        return None
    # The square root brightens the dark end, where most LiDAR returns lie.
    grey = (np.sqrt(np.clip(cloud.reflectance, 0, 1)) * 215 + 40).astype(np.uint8)
    return np.repeat(grey[:, None], 3, axis=1)


def render_pairs(
    cloud: PointCloud,
    axes: Sequence[Float64[np.ndarray, "3 3"]],
    config: ViewConfig,
    show: Float[np.ndarray, "m 3"] | None = None,
) -> list[PseudoView]:
    """Front and side pseudo-views of a cloud along several sets of axes: front 0, side 0, front 1, ...

    Args:
        cloud: at least one point, camera frame.
        axes: each with rows a1, a2, a3, right-handed and orthonormal. The front view looks along a3 with a1 to
            the right and a2 down; the side view shares a2 and has a3 to the right.
        show: additional points, metres, that must lie within the views (the corners of the last step's box).
    """
    from annotator.rcv import drawing_kernels as kernel

    if not axes:
        return []
    keep = drawn_points(len(cloud), config)
    drawn = cloud if keep is None else cloud.select(keep)
    # one row per coordinate, so that the loops run along contiguous memory
    xyz = np.array(drawn.xyz_m.T, order="C")
    front_axes = np.stack(axes)
    least, most = np.empty((2, len(front_axes), 3), np.float32)
    kernel.extents(xyz, front_axes.astype(np.float32), least, most)
    windows = pair_windows(front_axes, least, most, config, show)
    view_axes = np.stack([front_axes, side_axes(front_axes)], axis=1).reshape(-1, 3, 3)
    view_axes.flags.writeable = False
    # the side view looks along -a1
    depths = np.stack([least[:, 2], most[:, 2], -most[:, 0], -least[:, 0]], axis=1).reshape(-1, 2)
    packed = pack_colors(point_colors(drawn), len(drawn))
    images = draw_views(xyz, packed, view_axes.astype(np.float32), windows, depths, config.max_splat_px)
    return [
        PseudoView(image, rows, window.metres_per_px, window.origin_m, cloud.xyz_m)
        for image, rows, window in zip(images, view_axes, windows, strict=True)
    ]


def render_window(
    cloud: PointCloud, axes: Float64[np.ndarray, "3 3"], window: Window, max_splat_px: int
) -> UInt8[np.ndarray, "h w 3"]:
    """The image that a window of a view plane shows of a cloud; points outside the window are left out.

    Args:
        axes: rows = right, down, into the image.
        max_splat_px: as in `ViewConfig`.
    """
    from annotator.rcv import drawing_kernels as kernel

    reach = np.array([window.width_px, window.height_px])
    px = (cloud.xyz_m @ axes[:2].T - window.origin_m) / window.metres_per_px
    cloud = cloud.select(((px >= -0.5) & (px <= reach - 0.5)).all(axis=1))
    if not len(cloud):
        return np.full((window.height_px, window.width_px, 3), BACKGROUND, np.uint8)
    xyz, rows = np.array(cloud.xyz_m.T, order="C"), axes.astype(np.float32)[None]
    least, most = np.empty((2, 1, 3), np.float32)
    kernel.extents(xyz, rows, least, most)
    depths = np.stack([least[:, 2], most[:, 2]], axis=1)
    packed = pack_colors(point_colors(cloud), len(cloud))
    return draw_views(xyz, packed, rows, [window], depths, max_splat_px)[0]


def drawn_points(n_points: int, config: ViewConfig) -> Int64[np.ndarray, "m"] | None:
    """Indices of the points that are drawn, at most `points_per_px` per pixel; None = all points."""
    return thin(n_points, max(round(config.points_per_px * config.size_px**2), 1))


def pair_windows(
    axes: Float64[np.ndarray, "k 3 3"],
    least_m: Float32[np.ndarray, "k 3"],
    most_m: Float32[np.ndarray, "k 3"],
    config: ViewConfig,
    show: Float[np.ndarray, "m 3"] | None,
) -> list[Window]:
    """The windows of the views along each set of axes: front 0, side 0, front 1, ...

    Args:
        axes: rows a1, a2, a3 of each front view.
        least_m, most_m: the points' extent along these rows, metres.
        show: as in `render_pairs`.
    """
    low, high = least_m.astype(np.float64), most_m.astype(np.float64)
    if show is not None:
        corners = axes @ show.T
        low, high = np.minimum(low, corners.min(axis=2)), np.maximum(high, corners.max(axis=2))
    front_and_side = np.array([[0, 1], [2, 1]])
    return fit_windows(low[:, front_and_side].reshape(-1, 2), high[:, front_and_side].reshape(-1, 2), config)
