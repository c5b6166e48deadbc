"""Rendering of points: each is drawn as a square that closes gaps; a pixel shows the nearest point.

One integer key per point holds its depth and its index. The minimum key over the points of a pixel gives the nearest
point; the minimum over a neighbourhood draws points as squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8, UInt32

from annotator.rcv.config import ViewConfig

# The padding grey of letterboxing, so that the detector does not see the view's border.
BACKGROUND = 114
# The bits of the smallest and the largest normal positive float32: the range of keys.
LEAST_KEY, LAST_KEY = 0x00800000, 0x7F7FFFFF
# With more bits, float32 rounding would put points on a neighbouring level.
DEPTH_BITS = 20


@dataclass(frozen=True)
class Window:
    """The part of the view plane that a view shows: view coordinates of the first pixel's centre, scale and size."""

    origin_m: Float64[np.ndarray, "2"]
    metres_per_px: float
    width_px: int
    height_px: int


def fit_windows(
    low_m: Float64[np.ndarray, "v 2"], high_m: Float64[np.ndarray, "v 2"], config: ViewConfig
) -> list[Window]:
    """The windows that show view coordinates from `low_m` to `high_m`, with the configured border."""
    extent = np.maximum(high_m - low_m, config.min_extent_m) * (1 + 2 * config.padding)
    scale = extent.max(axis=1) / config.size_px
    size = np.clip(np.ceil(extent / scale[:, None]), min(8, config.size_px), config.size_px)
    origin = (low_m + high_m) / 2 - (size - 1) / 2 * scale[:, None]
    origin.flags.writeable = False
    sides = size.astype(int).tolist()
    return [Window(o, s, *side) for o, s, side in zip(origin, scale.tolist(), sides, strict=True)]


def splat_px(n_points: int, window: Window, largest: int) -> int:
    """Side of the square that a point is drawn as, odd: about the spacing of points spread evenly over the view."""
    spacing = (window.width_px * window.height_px / max(n_points, 1)) ** 0.5
    # The object fills only part of the view, so its points are denser than this spacing. Squares are still needed to
    # close single rows of missing pixels, which arise where the sensor's grid interferes with the view's.
    radius = round(0.5 * spacing - 0.15)
    return min(2 * radius + 1, largest - (1 - largest % 2))


def pack_colors(colors: UInt8[np.ndarray, "n 3"] | None, n_points: int) -> UInt32[np.ndarray, "packed"] | None:
    """Colours as integers, so that a view is one gather; the last entry is the background. None without colours."""
    if colors is None:
        return None
    packed = np.empty((n_points + 1, 4), np.uint8)
    cv2.cvtColor(colors[None], cv2.COLOR_BGR2BGRA, dst=packed[None, :n_points])
    packed[n_points] = BACKGROUND
    return packed.view(np.uint32)[:, 0]


@dataclass(frozen=True)
class KeyLayout:
    """How a point's depth and index share one integer.

    Attributes:
        index_bits: number of low bits that hold the index.
        levels: number of depth levels; the last one is the background's.
        empty: the key of a pixel without a point; larger than the key of any point.
    """

    index_bits: int
    levels: int
    empty: int

    @classmethod
    def of(cls, n_points: int) -> KeyLayout:
        """The layout for a number of points; depth uses the bits that the index does not need.

        For 50,000 points over a depth of 30 m, a level is a millimetre.
        """
        index_bits = n_points.bit_length()
        levels = min((LAST_KEY - LEAST_KEY) >> index_bits, 1 << DEPTH_BITS) - 1
        return cls(index_bits, levels, LEAST_KEY + (levels << index_bits) + n_points)

    def scale(self, near_m: float, far_m: float) -> float:
        """Levels per metre."""
        return (self.levels - 1) / max(far_m - near_m, 1e-6)


def draw_views(
    xyz_m: Float32[np.ndarray, "3 n"],
    packed: UInt32[np.ndarray, "packed"] | None,
    axes: Float32[np.ndarray, "v 3 3"],
    windows: Sequence[Window],
    depths_m: Float[np.ndarray, "v 2"],
    largest_splat_px: int,
) -> list[UInt8[np.ndarray, "_ _ 3"]]:
    """Images of the same points, one per view; each pixel shows the nearest point. The images share one buffer.

    Args:
        xyz_m: one row per coordinate.
        packed: from `pack_colors`; None shades by depth, near points light.
        axes: of each view, rows = right, down, into the image.
        windows: of each view; points outside are drawn at its border.
        depths_m: smallest and largest depth of the points in each view.
        largest_splat_px: largest square that a point is drawn as.
    """
    from annotator.rcv import drawing_kernels as kernel

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
    rgb.flags.writeable = False  # before slicing, so that all slices are read-only
    return [
        rgb[begin : begin + length].reshape(w.height_px, w.width_px, 3)
        for begin, length, w in zip(begins.tolist(), lengths.tolist(), windows, strict=True)
    ]
