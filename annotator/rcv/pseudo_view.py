"""Pseudo-views: orthographic RGB pictures of a cloud along the axes of a frame (RCV paper, section II.C)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64, UInt8

from annotator.geometry.thinning import thin
from annotator.rcv.config import ViewConfig
from annotator.rcv.drawing import Window, draw_views, fit_windows, pack_colors
from annotator.types import PointCloud, PseudoView


def side_axes(frame: Float64[np.ndarray, "*k 3 3"]) -> Float64[np.ndarray, "*k 3 3"]:
    """Rows = x, y, z of the view that shares a2 with the front view (whose rows are the frame's: a1, a2, a3, camera
    frame) and has a3 to the right."""
    return np.stack([frame[..., 2, :], frame[..., 1, :], -frame[..., 0, :]], axis=-2)


def point_colors(cloud: PointCloud) -> UInt8[np.ndarray, "n 3"] | None:
    """The colours of a cloud, grey by reflectance where it has none, or None where only depth can shade it."""
    if cloud.rgb is not None:
        return cloud.rgb
    if cloud.reflectance is None:
        return None
    # The square root lifts the dark end, where most LiDAR returns lie.
    grey = (np.sqrt(np.clip(cloud.reflectance, 0, 1)) * 215 + 40).astype(np.uint8)
    return np.repeat(grey[:, None], 3, axis=1)


def render_pairs(
    cloud: PointCloud,
    frames: Sequence[Float64[np.ndarray, "3 3"]],
    config: ViewConfig,
    show: Float[np.ndarray, "m 3"] | None = None,
) -> list[PseudoView]:
    """Front and side pseudo-view of a cloud along each of several frames: front 0, side 0, front 1, ...

    Args:
        cloud: at least one point, camera frame.
        frames: each with rows a1, a2, a3, right-handed and orthonormal. The front view looks along a3 with a1 to
            the right and a2 down; the side view shares a2 and has a3 to the right.
        show: more points, metres, that must lie within the pictures (the last step's box corners).
    """
    from annotator.rcv.kernels import drawing as kernel

    if not frames:
        return []
    keep = drawn_points(len(cloud), config)
    drawn = cloud if keep is None else cloud.select(keep)
    # One row an axis: everything that follows runs along contiguous memory.
    xyz = np.array(drawn.xyz_m.T, order="C")
    rows = np.stack(frames)
    least, most = np.empty((2, len(rows), 3), np.float32)
    kernel.extents(xyz, rows.astype(np.float32), least, most)
    windows = pair_windows(rows, least, most, config, show)
    axes = np.stack([rows, side_axes(rows)], axis=1).reshape(-1, 3, 3)
    axes.flags.writeable = False
    # the side view looks along -a1
    depths = np.stack([least[:, 2], most[:, 2], -most[:, 0], -least[:, 0]], axis=1).reshape(-1, 2)
    packed = pack_colors(point_colors(drawn), len(drawn))
    pictures = draw_views(xyz, packed, axes.astype(np.float32), windows, depths, config.max_splat_px)
    return [
        PseudoView(picture, own, window.metres_per_px, window.origin_m, cloud.xyz_m)
        for picture, own, window in zip(pictures, axes, windows, strict=True)
    ]


def drawn_points(n_points: int, config: ViewConfig) -> Int64[np.ndarray, "m"] | None:
    """Numbers of the points of a cloud that its pictures are made of, as many as can be seen in them; None = all."""
    return thin(n_points, max(round(config.points_per_px * config.size_px**2), 1))


def pair_windows(
    frames: Float64[np.ndarray, "k 3 3"],
    least_m: Float32[np.ndarray, "k 3"],
    most_m: Float32[np.ndarray, "k 3"],
    config: ViewConfig,
    show: Float[np.ndarray, "m 3"] | None,
) -> list[Window]:
    """What the front and the side view along each frame show, in turn, of points that reach from `least_m` to `most_m`
    along its rows.

    Args:
        show: as in `render_pairs`.
    """
    low, high = least_m.astype(np.float64), most_m.astype(np.float64)
    if show is not None:
        corners = frames @ show.T
        low, high = np.minimum(low, corners.min(axis=2)), np.maximum(high, corners.max(axis=2))
    front_and_side = np.array([[0, 1], [2, 1]])
    return fit_windows(low[:, front_and_side].reshape(-1, 2), high[:, front_and_side].reshape(-1, 2), config)
