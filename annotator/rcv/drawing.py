"""Points as a picture: each at its pixel, the nearest in front, near points as squares that close the gaps.

One integer a point holds its depth and its number, so that a plain minimum over the points of a pixel finds the nearest
and says which one it is; the minimum over a neighbourhood makes squares of the points. The integers are also the bits
of positive floats, whose order is the same: on a graphics processor (`annotator.gpu`) filters know floats only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8, UInt32

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


def fit_windows(
    low_m: Float64[np.ndarray, "v 2"], high_m: Float64[np.ndarray, "v 2"], config: ViewConfig
) -> list[Window]:
    """The windows that show view coordinates from `low_m` to `high_m` with the configured border."""
    extent = np.maximum(high_m - low_m, config.min_extent_m) * (1 + 2 * config.padding)
    scale = extent.max(axis=1) / config.size_px
    size = np.clip(np.ceil(extent / scale[:, None]), min(8, config.size_px), config.size_px)
    origin = (low_m + high_m) / 2 - (size - 1) / 2 * scale[:, None]
    origin.flags.writeable = False
    sides = size.astype(int).tolist()
    return [Window(o, s, *side) for o, s, side in zip(origin, scale.tolist(), sides, strict=True)]


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


def draw_views(
    xyz_m: Float32[np.ndarray, "3 n"],
    packed: UInt32[np.ndarray, "packed"] | None,
    axes: Float32[np.ndarray, "v 3 3"],
    windows: Sequence[Window],
    depths_m: Float[np.ndarray, "v 2"],
    largest_splat_px: int,
) -> list[UInt8[np.ndarray, "_ _ 3"]]:
    """One picture a view of the same points; the nearest point wins a pixel. The pictures share their memory.

    Args:
        xyz_m: one row an axis.
        packed: from `pack_colors`; None shades by depth, near points light.
        axes: of each view, rows = right, down, into the page.
        windows: of each view; points outside are drawn at its border.
        depths_m: least and largest depth of the points in each view.
    """
    from annotator.rcv.kernels import drawing as kernel

    n, layout = xyz_m.shape[1], KeyLayout.of(xyz_m.shape[1])
    sizes = np.array([(w.width_px, w.height_px) for w in windows], np.int64).reshape(-1, 2)
    corners = np.array([(*(w.origin_m - w.metres_per_px / 2), 1 / w.metres_per_px) for w in windows], np.float32)
    depths = np.array([(near, layout.scale(near, far)) for near, far in depths_m.tolist()], np.float32)
    splats = np.array([splat_px(n, window, largest_splat_px) for window in windows], np.int64)
    bits = np.array([layout.index_bits, layout.levels, LEAST_KEY, BACKGROUND], np.int64)
    lengths = sizes.prod(axis=1)
    begins = np.cumsum(lengths) - lengths
    pixels = np.empty((1, int(lengths.sum())), np.uint32)
    colors = np.zeros(1, np.uint32) if packed is None else packed
    kernel.draw_views(xyz_m, colors, axes, sizes, corners, depths, splats, bits, begins, pixels[0])
    rgb = cv2.cvtColor(pixels.view(np.uint8).reshape(1, -1, 4), cv2.COLOR_BGRA2BGR)[0]
    rgb.flags.writeable = False  # at once, since views of it would be made read-only one by one
    return [
        rgb[begin : begin + length].reshape(w.height_px, w.width_px, 3)
        for begin, length, w in zip(begins.tolist(), lengths.tolist(), windows, strict=True)
    ]
