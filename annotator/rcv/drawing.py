"""Points as a picture: each at its pixel, the nearest in front, near points as squares that close the gaps.

One integer a point holds its depth and its number, so that a plain minimum over the points of a pixel finds the nearest
and says which one it is. The integers are also the bits of positive floats, whose order is the same, so that OpenCV's
minimum filter (which knows floats and no long integers) makes squares of the points.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8, UInt32

from annotator.rcv.config import ViewConfig

# The grey that letterboxing pads with, so that a view's own border is not a feature of the picture.
BACKGROUND = 114
# The bits of the least and of the largest normal positive float32; what lies between are the keys.
LEAST_KEY, LAST_KEY = 0x00800000, 0x7F7FFFFF
# More than float32 can tell apart would overflow into the next level.
DEPTH_BITS = 20


@dataclass(frozen=True)
class Window:
    """What a view shows: the view coordinates of its first pixel's centre, the scale and the size."""

    origin_m: Float64[np.ndarray, "2"]
    metres_per_px: float
    width_px: int
    height_px: int


def fit_window(low_m: Float64[np.ndarray, "2"], high_m: Float64[np.ndarray, "2"], config: ViewConfig) -> Window:
    """The window that shows view coordinates from `low_m` to `high_m` with the configured border."""
    extent = np.maximum(high_m - low_m, config.min_extent_m)
    center = (low_m + high_m) / 2
    extent = extent * (1 + 2 * config.padding)
    scale = float(extent.max()) / config.size_px
    size = np.clip(np.ceil(extent / scale), min(8, config.size_px), config.size_px).astype(int)
    return Window(center - (size - 1) / 2 * scale, scale, int(size[0]), int(size[1]))


def splat_px(n_points: int, window: Window, largest: int) -> int:
    """Odd side length of the square that a point is drawn as: about the spacing of points spread over the picture."""
    spacing = (window.width_px * window.height_px / max(n_points, 1)) ** 0.5
    # The object fills only part of the picture, so its points lie denser; but single rows of missing pixels, where
    # the sensor's grid and the picture's beat against each other, are worth closing.
    radius = round(0.5 * spacing - 0.15)
    return min(2 * radius + 1, largest - (1 - largest % 2))


def pack_colors(colors: UInt8[np.ndarray, "n 3"] | None, n_points: int) -> UInt32[np.ndarray, "packed"] | None:
    """One integer a point (so that a picture is one gather), and the background as an extra last entry."""
    if colors is None:
        return None
    packed = np.empty((n_points + 1, 4), np.uint8)
    cv2.cvtColor(colors[None], cv2.COLOR_BGR2BGRA, dst=packed[None, :n_points])
    packed[n_points] = BACKGROUND
    return packed.view(np.uint32)[:, 0]


@dataclass(frozen=True)
class KeyLayout:
    """How a point's depth and number share one integer.

    Attributes:
        index_bits: the lowest bits hold the number.
        levels: how many depths can be told apart; the last is the background's.
        empty: the key of a pixel without a point, larger than any point's.
    """

    index_bits: int
    levels: int
    empty: int

    @classmethod
    def of(cls, n_points: int) -> KeyLayout:
        """The index takes as many of the bits as it needs, depth the rest: a millimetre a level for 50,000 points in
        30 m."""
        index_bits = n_points.bit_length()
        levels = min((LAST_KEY - LEAST_KEY) >> index_bits, 1 << DEPTH_BITS) - 1
        return cls(index_bits, levels, LEAST_KEY + (levels << index_bits) + n_points)

    def scale(self, near_m: float, far_m: float) -> float:
        """Levels a metre."""
        return (self.levels - 1) / max(far_m - near_m, 1e-6)


def draw(
    right_m: Float32[np.ndarray, "n"],
    down_m: Float32[np.ndarray, "n"],
    depth_m: Float32[np.ndarray, "n"],
    packed: UInt32[np.ndarray, "packed"] | None,
    window: Window,
    largest_splat_px: int,
    depth_range_m: tuple[float, float] | None = None,
) -> UInt8[np.ndarray, "h w 3"]:
    """The picture of points at view coordinates, `depth_m` into the page; the nearest point wins a pixel.

    Args:
        packed: from `pack_colors`; None shades by depth, near points light.
        window: must contain all the points.
        depth_range_m: least and largest depth, where they are known.
    """
    n = len(depth_m)
    layout = KeyLayout.of(n)
    index_bits = layout.index_bits
    near, far = depth_range_m or (float(depth_m.min()), float(depth_m.max()))
    depth = depth_m - np.float32(near)
    depth *= np.float32(layout.scale(near, far))
    level = depth.astype(np.uint32)
    level <<= np.uint32(index_bits)
    level += np.arange(LEAST_KEY, LEAST_KEY + n, dtype=np.uint32)
    nearest = np.full((window.height_px, window.width_px), layout.empty, np.uint32)
    np.minimum.at(nearest.reshape(-1), _pixel(right_m, down_m, window), level)
    if (splat := splat_px(n, window, largest_splat_px)) > 1:
        nearest = cv2.erode(nearest.view(np.float32), np.ones((splat, splat), np.uint8)).view(np.uint32)
    nearest -= np.uint32(LEAST_KEY)
    if packed is None:
        return _shaded(nearest >> np.uint32(index_bits), layout.levels)
    index = (nearest & np.uint32((1 << index_bits) - 1)).astype(np.intp)
    # no index is out of range: "clip" only spares the copy that a check needs
    colors = np.take(packed, index, out=nearest, mode="clip").view(np.uint8)
    return cv2.cvtColor(colors.reshape(*index.shape, 4), cv2.COLOR_BGRA2BGR)


def _pixel(
    right_m: Float32[np.ndarray, "n"], down_m: Float32[np.ndarray, "n"], window: Window
) -> Int32[np.ndarray, "n"]:
    """Which pixel of the picture, counted row by row, each point falls on."""
    scale = np.float32(1 / window.metres_per_px)
    # Adding a half and cutting off rounds to the nearest pixel, since no coordinate is negative.
    left, top = (window.origin_m - window.metres_per_px / 2).astype(np.float32)
    across = right_m - left
    across *= scale
    column = across.astype(np.int32)
    np.subtract(down_m, top, out=across)
    across *= scale
    row = across.astype(np.int32)
    # Without a border in the window, rounding can put the outermost point one pixel outside.
    np.minimum(column, window.width_px - 1, out=column)
    np.minimum(row, window.height_px - 1, out=row)
    row *= window.width_px
    row += column
    return row


def _shaded(level: UInt32[np.ndarray, "h w"], levels: int) -> UInt8[np.ndarray, "h w 3"]:
    """Grey by depth, near points light; no point has the last level, which is the background's."""
    grey = (250 - 190 * (level.astype(np.float32) / levels)).astype(np.uint8)
    grey[level == levels] = BACKGROUND
    return cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
