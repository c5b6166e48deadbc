"""Pseudo-views: orthographic RGB pictures of a cloud along the axes of a frame (RCV paper, section II.C)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8, UInt32

from annotator.rcv.config import ViewConfig
from annotator.types import PointCloud, PseudoView

# The grey that letterboxing pads with, so that a view's own border is not a feature of the picture.
BACKGROUND = 114
KEY_BITS = 32
# More than float32 can tell apart would overflow into the next level.
DEPTH_BITS = 20


@dataclass(frozen=True)
class Window:
    """What a view shows: the view coordinates of its first pixel's centre, the scale and the size."""

    origin_m: Float64[np.ndarray, "2"]
    metres_per_px: float
    width_px: int
    height_px: int


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


def fit_window(low_m: np.ndarray, high_m: np.ndarray, config: ViewConfig) -> Window:
    """The window that shows view coordinates from `low_m` to `high_m` (2,) with the configured border."""
    extent = np.maximum(high_m - low_m, config.min_extent_m)
    center = (low_m + high_m) / 2
    extent = extent * (1 + 2 * config.padding)
    scale = float(extent.max()) / config.size_px
    size = np.clip(np.ceil(extent / scale), min(8, config.size_px), config.size_px).astype(int)
    return Window(center - (size - 1) / 2 * scale, scale, int(size[0]), int(size[1]))


def splat_px(n_points: int, window: Window, largest: int) -> int:
    """Odd side length of the square that a point is drawn as: about the spacing of points spread over the picture."""
    spacing = np.sqrt(window.width_px * window.height_px / max(n_points, 1))
    # The object fills only part of the picture, so its points lie denser; but single rows of missing pixels, where
    # the sensor's grid and the picture's beat against each other, are worth closing.
    radius = int(np.round(0.5 * spacing - 0.15))
    return min(2 * radius + 1, largest - (1 - largest % 2))


def pack_colors(colors: UInt8[np.ndarray, "n 3"] | None, n_points: int) -> UInt32[np.ndarray, "packed"] | None:
    """One integer a point (so that a picture is one gather), and the background as an extra last entry."""
    if colors is None:
        return None
    packed = np.empty((n_points + 1, 4), np.uint8)
    cv2.cvtColor(colors[None], cv2.COLOR_BGR2BGRA, dst=packed[None, :n_points])
    packed[n_points] = BACKGROUND
    return packed.view(np.uint32)[:, 0]


def draw(
    right_m: Float32[np.ndarray, "n"],
    down_m: Float32[np.ndarray, "n"],
    depth_m: Float32[np.ndarray, "n"],
    packed: UInt32[np.ndarray, "packed"] | None,
    window: Window,
    largest_splat_px: int,
) -> UInt8[np.ndarray, "h w 3"]:
    """The picture of points at view coordinates, `depth_m` into the page; the nearest point wins a pixel.

    Args:
        packed: from `pack_colors`; None shades by depth, near points light.
        window: must contain all the points.
    """
    n = len(depth_m)
    scale = np.float32(1 / window.metres_per_px)
    # Adding a half and cutting off rounds to the nearest pixel, since no coordinate is negative.
    column = ((right_m - np.float32(window.origin_m[0] - window.metres_per_px / 2)) * scale).astype(np.int32)
    row = ((down_m - np.float32(window.origin_m[1] - window.metres_per_px / 2)) * scale).astype(np.int32)
    # One integer orders points by depth and remembers which point it is, so that a plain minimum draws them. The
    # index takes as many of the bits as it needs, depth the rest: half a millimetre a level for 50,000 points in
    # 30 m. Narrow integers keep the buffers in the cache.
    index_bits = n.bit_length()
    levels = (1 << min(KEY_BITS - index_bits, DEPTH_BITS)) - 1
    # Without a border in the window, rounding can put the outermost point one pixel outside.
    np.minimum(column, window.width_px - 1, out=column)
    np.minimum(row, window.height_px - 1, out=row)
    near, far = float(depth_m.min()), float(depth_m.max())
    level = ((depth_m - np.float32(near)) * np.float32((levels - 1) / max(far - near, 1e-6))).astype(np.uint32)
    key = (level << np.uint32(index_bits)) | np.arange(n, dtype=np.uint32)
    empty = np.uint32((levels << index_bits) | n)
    nearest = np.full(window.height_px * window.width_px, empty, np.uint32)
    np.minimum.at(nearest, row * window.width_px + column, key)
    grown = nearest.reshape(window.height_px, window.width_px)
    if (splat := splat_px(n, window, largest_splat_px)) > 1:
        grown = _grow(grown, splat // 2, empty)
    if packed is not None:
        index = (grown & np.uint32((1 << index_bits) - 1)).astype(np.intp)
        four = np.take(packed, index).view(np.uint8).reshape(*grown.shape, 4)
        return cv2.cvtColor(four, cv2.COLOR_BGRA2BGR)
    shade = (grown >> np.uint32(index_bits)).astype(np.float32) / levels
    grey = (250 - 190 * shade).astype(np.uint8)
    grey[grown == empty] = BACKGROUND
    return cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)


def _grow(nearest: UInt32[np.ndarray, "h w"], radius: int, empty: np.uint32) -> UInt32[np.ndarray, "h w"]:
    """Each point drawn as a square of 2 radius + 1: a minimum filter, so near points cover far ones."""
    grown = np.pad(nearest, radius, constant_values=empty)
    for _ in (0, 1):  # along the rows, then, transposed, along the columns
        width = 1
        while width < 2 * radius + 1:  # a window of twice the width is the minimum of two windows
            shift = min(width, 2 * radius + 1 - width)
            grown = np.minimum(grown[:-shift], grown[shift:])
            width += shift
        grown = np.ascontiguousarray(grown.T)
    return grown


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
    return [view for frame in frames for view in _render_pair(cloud, packed, frame, config, show)]


def _render_pair(
    cloud: PointCloud,
    packed: UInt32[np.ndarray, "packed"] | None,
    frame: Float64[np.ndarray, "3 3"],
    config: ViewConfig,
    show: Float[np.ndarray, "m 3"] | None,
) -> tuple[PseudoView, PseudoView]:
    # One row an axis: reductions and pixel arithmetic run along contiguous memory.
    along = np.ascontiguousarray(frame.astype(np.float32) @ cloud.xyz_m.T)
    low, high = along.min(axis=1).astype(np.float64), along.max(axis=1).astype(np.float64)
    if show is not None:
        corners = frame @ show.T
        low, high = np.minimum(low, corners.min(axis=1)), np.maximum(high, corners.max(axis=1))

    def view(axes: np.ndarray, right: int, down: int, depth: np.ndarray) -> PseudoView:
        window = fit_window(low[[right, down]], high[[right, down]], config)
        picture = draw(along[right], along[down], depth, packed, window, config.max_splat_px)
        return PseudoView(picture, axes, window.metres_per_px, window.origin_m, cloud.xyz_m)

    return view(frame, 0, 1, along[2]), view(side_axes(frame), 2, 1, -along[0])
