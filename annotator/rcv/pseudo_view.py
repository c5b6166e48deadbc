"""Pseudo-views: orthographic RGB images of a cloud along given axes (RCV paper, section II.C)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64, Int64, UInt8, UInt32

from annotator.geometry.projection import thin
from annotator.geometry.transforms import unit
from annotator.rcv.config import RcvConfig
from annotator.types import PointCloud, PseudoView

# Rendering of points: each is drawn as a square that closes gaps; a pixel shows the nearest point.
#
# One integer key per point holds its depth and its index. The minimum key over the points of a pixel gives the
# nearest point; the minimum over a neighbourhood draws points as squares.


# The padding grey of letterboxing, so that the detector does not see the view's border.
BACKGROUND = 114
# Smallest extent that a view shows, metres, and largest square that a point is drawn as, pixels.
MIN_EXTENT_M, MAX_SPLAT_PX = 0.02, 9
# Empty border of a view on each side, share of the shown extent.
PADDING = 0.06
# Depth/width ratio of a frustum above which its first views are larger, and their longer side, pixels.
DEEP, DEEP_VIEW_PX = 2.0, 224
# Larger clouds are thinned to this many points per pixel of a square view.
POINTS_PER_PX = 4
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


def fit_windows(low_m: Float64[np.ndarray, "v 2"], high_m: Float64[np.ndarray, "v 2"], size_px: int) -> list[Window]:
    """The windows that show view coordinates from `low_m` to `high_m`, with a border."""
    extent = np.maximum(high_m - low_m, MIN_EXTENT_M) * (1 + 2 * PADDING)
    scale = extent.max(axis=1) / size_px
    size = np.clip(np.ceil(extent / scale[:, None]), min(8, size_px), size_px)
    origin = (low_m + high_m) / 2 - (size - 1) / 2 * scale[:, None]
    origin.flags.writeable = False
    sides = size.astype(int).tolist()
    return [Window(o, s, *side) for o, s, side in zip(origin, scale.tolist(), sides, strict=True)]


def splat_px(n_points: int, window: Window) -> int:
    """Side of the square that a point is drawn as, odd: about the spacing of points spread evenly over the view."""
    spacing = (window.width_px * window.height_px / max(n_points, 1)) ** 0.5
    # The object fills only part of the view, so its points are denser than this spacing. Squares are still needed to
    # close single rows of missing pixels, which arise where the sensor's grid interferes with the view's.
    radius = round(0.5 * spacing - 0.15)
    return min(2 * radius + 1, MAX_SPLAT_PX)


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
) -> list[UInt8[np.ndarray, "_ _ 3"]]:
    """Images of the same points, one per view; each pixel shows the nearest point. The images share one buffer.

    Args:
        xyz_m: one row per coordinate.
        packed: from `pack_colors`; None shades by depth, near points light.
        axes: of each view, rows = right, down, into the image.
        windows: of each view; points outside are drawn at its border.
        depths_m: smallest and largest depth of the points in each view.
    """
    from annotator.rcv import drawing_kernels as kernel

    n, layout = xyz_m.shape[1], KeyLayout.of(xyz_m.shape[1])
    sizes = np.array([(w.width_px, w.height_px) for w in windows], np.int64).reshape(-1, 2)
    corners = np.array([(*(w.origin_m - w.metres_per_px / 2), 1 / w.metres_per_px) for w in windows], np.float32)
    depths = np.array([(near, layout.scale(near, far)) for near, far in depths_m.tolist()], np.float32)
    splats = np.array([splat_px(n, window) for window in windows], np.int64)
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
    size_px: int,
    show: Float[np.ndarray, "m 3"] | None = None,
    *,
    every_point: bool = False,
) -> list[PseudoView]:
    """Front and side pseudo-views of a cloud along several sets of axes: front 0, side 0, front 1, ...

    Args:
        cloud: at least one point, camera frame.
        size_px: longer side of a view.
        axes: each with rows a1, a2, a3, right-handed and orthonormal. The front view looks along a3 with a1 to
            the right and a2 down; the side view shares a2 and has a3 to the right.
        show: additional points, metres, that must lie within the views (the corners of the last step's box).
        every_point: draws dense clouds as they are, too.
    """
    from annotator.rcv import drawing_kernels as kernel

    if not axes:
        return []
    keep = None if every_point else drawn_points(len(cloud), size_px)
    drawn = cloud if keep is None else cloud.select(keep)
    # one row per coordinate, so that the loops run along contiguous memory
    xyz = np.array(drawn.xyz_m.T, order="C")
    front_axes = np.stack(axes)
    least, most = np.empty((2, len(front_axes), 3), np.float32)
    kernel.extents(xyz, front_axes.astype(np.float32), least, most)
    windows = pair_windows(front_axes, least, most, size_px, show)
    view_axes = np.stack([front_axes, side_axes(front_axes)], axis=1).reshape(-1, 3, 3)
    view_axes.flags.writeable = False
    # the side view looks along -a1
    depths = np.stack([least[:, 2], most[:, 2], -most[:, 0], -least[:, 0]], axis=1).reshape(-1, 2)
    packed = pack_colors(point_colors(drawn), len(drawn))
    images = draw_views(xyz, packed, view_axes.astype(np.float32), windows, depths)
    return [
        PseudoView(image, rows, window.metres_per_px, window.origin_m, cloud.xyz_m)
        for image, rows, window in zip(images, view_axes, windows, strict=True)
    ]


def render_window(cloud: PointCloud, axes: Float64[np.ndarray, "3 3"], window: Window) -> UInt8[np.ndarray, "h w 3"]:
    """The image that a window of a view plane shows of a cloud; points outside the window are left out.

    Args:
        axes: rows = right, down, into the image.
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
    return draw_views(xyz, packed, rows, [window], depths)[0]


def drawn_points(n_points: int, size_px: int) -> Int64[np.ndarray, "m"] | None:
    """Indices of the points that are drawn on a view whose longer side has `size_px`; None = all points."""
    return thin(n_points, POINTS_PER_PX * size_px**2)


def pair_windows(
    axes: Float64[np.ndarray, "k 3 3"],
    least_m: Float32[np.ndarray, "k 3"],
    most_m: Float32[np.ndarray, "k 3"],
    size_px: int,
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
    return fit_windows(low[:, front_and_side].reshape(-1, 2), high[:, front_and_side].reshape(-1, 2), size_px)


def frustum_views(
    cloud: PointCloud,
    axes: Float64[np.ndarray, "3 3"],
    config: RcvConfig,
    *,
    enlarge_deep: bool = True,
) -> tuple[PseudoView, PseudoView]:
    """Both views of a frustum's points. For a deep frustum they are larger, also as the detector's input.

    Args:
        cloud: at least one point, camera frame.
        axes: as in `render_pairs`.
        enlarge_deep: False for crops of a frustum, which class-agnostic detectors see at the usual size.
    """
    is_large = enlarge_deep and is_deep(cloud)
    size_px = max(config.view_px, DEEP_VIEW_PX) if is_large else config.view_px
    # all points are drawn, because thinning would leave too few points of a far object
    front, side = render_pairs(cloud, [axes], size_px, every_point=True)
    if not is_large:
        return front, side
    return replace(front, look_px=DEEP_VIEW_PX), replace(side, look_px=DEEP_VIEW_PX)


def is_deep(cloud: PointCloud) -> bool:
    """True if a frustum's depth is more than `DEEP` times its width and height.

    The object is then small in the side view: with 60 m of street behind, a pedestrian is 2 of 96 pixels wide.
    Depth is measured along the frustum, which may lie at any angle to the camera's axis.
    """
    from annotator.rcv import drawing_kernels as kernel

    xyz = np.array(cloud.xyz_m.T, order="C")
    forward = unit(xyz.mean(axis=1, dtype=np.float64))
    across = unit(np.cross([0.0, 1.0, 0.0], forward))
    frustum_axes = np.stack([across, np.cross(forward, across), forward]).astype(np.float32)
    least, most = np.empty((2, 1, 3), np.float32)
    kernel.extents(xyz, frustum_axes[None], least, most)
    width, height, depth = (most - least)[0].tolist()
    return bool(depth > DEEP * max(width, height))
