"""Pseudo-views: orthographic RGB pictures of a cloud along the axes of a frame (RCV paper, section II.C)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8, UInt32

from annotator.rcv.config import ViewConfig
from annotator.rcv.drawing import Window, draw, fit_window, pack_colors
from annotator.types import PointCloud, PseudoView


def side_axes(frame: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    """Rows = x, y, z of the view that shares a2 with the front view (whose rows are the frame's: a1, a2, a3, camera
    frame) and has a3 to the right."""
    return np.stack([frame[2], frame[1], -frame[0]])


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
    packed = pack_colors(point_colors(cloud), len(cloud))
    # One row an axis: everything that follows runs along contiguous memory.
    xyz = np.ascontiguousarray(cloud.xyz_m.T)
    return [view for frame in frames for view in _render_pair(cloud, xyz, packed, frame, config, show)]


def _render_pair(
    cloud: PointCloud,
    xyz: Float32[np.ndarray, "3 n"],
    packed: UInt32[np.ndarray, "packed"] | None,
    frame: Float64[np.ndarray, "3 3"],
    config: ViewConfig,
    show: Float[np.ndarray, "m 3"] | None,
) -> tuple[PseudoView, PseudoView]:
    along = frame.astype(np.float32) @ xyz
    least, most = along.min(axis=1), along.max(axis=1)
    windows = pair_windows(frame, least, most, config, show)

    def view(
        window: Window, axes: np.ndarray, across: list[int], depth: np.ndarray, near: float, far: float
    ) -> PseudoView:
        right, down = along[across[0]], along[across[1]]
        picture = draw(right, down, depth, packed, window, config.max_splat_px, (near, far))
        return PseudoView(picture, axes, window.metres_per_px, window.origin_m, cloud.xyz_m)

    front = view(windows[0], frame, [0, 1], along[2], float(least[2]), float(most[2]))
    return front, view(windows[1], side_axes(frame), [2, 1], -along[0], float(-most[0]), float(-least[0]))


def pair_windows(
    frame: Float64[np.ndarray, "3 3"],
    least_m: Float32[np.ndarray, "3"],
    most_m: Float32[np.ndarray, "3"],
    config: ViewConfig,
    show: Float[np.ndarray, "m 3"] | None,
) -> tuple[Window, Window]:
    """What the front and the side view of points show that reach from `least_m` to `most_m` along the frame's rows.

    Args:
        show: as in `render_pairs`.
    """
    low, high = least_m.astype(np.float64), most_m.astype(np.float64)
    if show is not None:
        corners = frame @ show.T
        low, high = np.minimum(low, corners.min(axis=1)), np.maximum(high, corners.max(axis=1))
    front, side = [0, 1], [2, 1]
    return fit_window(low[front], high[front], config), fit_window(low[side], high[side], config)
