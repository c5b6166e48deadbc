"""Rendering of pseudo-views on a device, all views of a step at once, as in `annotator.rcv.drawing`.

The keys are the same: a point's depth and index packed into one integer, which is also the bit pattern of a positive
float. A scattered minimum finds the nearest point of each pixel in all images. A maximum filter over negative
floats draws the points as squares. There are two synchronisations: for the extents, which determine the windows, and
for the images.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8

from annotator.gpu.points import DeviceCloud, DevicePoints
from annotator.rcv.config import ViewConfig
from annotator.rcv.drawing import BACKGROUND, LEAST_KEY, KeyLayout, Window, splat_px
from annotator.rcv.pseudo_view import drawn_points, pair_windows, side_axes
from annotator.types import PseudoView

# Points or pixels per pass; bounds the memory, at about 50 bytes each.
MAX_AT_ONCE = 1 << 24


def render_pairs(
    cloud: DeviceCloud,
    axes: Sequence[Float64[np.ndarray, "3 3"]],
    config: ViewConfig,
    show: Float[np.ndarray, "m 3"] | None = None,
) -> list[PseudoView]:
    """As `annotator.rcv.pseudo_view.render_pairs`; a point midway between two pixels may be drawn at either."""
    import torch

    keep = drawn_points(len(cloud), config)
    drawn = cloud if keep is None else cloud.select(keep)
    points = drawn.on_device()
    axes_per_pass = max(MAX_AT_ONCE // (2 * max(len(drawn), config.size_px**2)), 1)
    views: list[PseudoView] = []
    for begin in range(0, len(axes), axes_per_pass):
        part = axes[begin : begin + axes_per_pass]
        along = _along(points, part)
        least, most = torch.stack([along.amin(dim=2), along.amax(dim=2)]).cpu().numpy()
        front_axes = np.stack(part)
        windows = pair_windows(front_axes, least, most, config, show)
        view_axes = np.stack([front_axes, side_axes(front_axes)], axis=1).reshape(-1, 3, 3)
        images = _images(points, along, least, most, windows, config.max_splat_px)
        for canvas, rows, window in zip(images, view_axes, windows, strict=True):
            # a copy, so that a view does not keep the images of all others in memory
            rgb = canvas[: window.height_px, : window.width_px].copy()
            views.append(PseudoView(rgb, rows, window.metres_per_px, window.origin_m, cloud.xyz_m))
    return views


def _along(points: DevicePoints, axes: Sequence[Float64[np.ndarray, "3 3"]]) -> Any:
    """Coordinates (k, 3, n) of the points along the rows of each set of axes.

    Computed as a sum of products, since a GPU may use reduced precision for matrix products.
    """
    import torch

    rows = torch.tensor(np.stack(axes).astype(np.float32), device=points.xyz.device)[..., None]
    return rows[:, :, 0] * points.xyz[0] + rows[:, :, 1] * points.xyz[1] + rows[:, :, 2] * points.xyz[2]


def _images(
    points: DevicePoints,
    along: Any,
    least: Float32[np.ndarray, "k 3"],
    most: Float32[np.ndarray, "k 3"],
    windows: Sequence[Window],
    largest_splat_px: int,
) -> UInt8[np.ndarray, "v h w 3"]:
    """The images of all windows, each in the upper left corner of a canvas of the largest size.

    Args:
        along: (k, 3, n) from `_along`, between `least` and `most`.
        windows: v = 2 k, front and side in turn.
    """
    import torch

    n, layout = along.shape[2], KeyLayout.of(along.shape[2])
    near, far = np.stack([least[:, 2], -most[:, 0]], 1), np.stack([most[:, 2], -least[:, 0]], 1)
    depth = torch.stack([along[:, 2], -along[:, 0]], dim=1)
    pairs = zip(near.reshape(-1).tolist(), far.reshape(-1).tolist(), strict=True)
    scales = np.array([layout.scale(*pair) for pair in pairs], np.float32).reshape(-1, 2, 1)
    levels = (depth - _to(near[..., None], along)) * _to(scales, along)
    keys = (levels.to(torch.int32) << layout.index_bits) + torch.arange(
        LEAST_KEY, LEAST_KEY + n, dtype=torch.int32, device=along.device
    )
    shape = (len(windows), max(w.height_px for w in windows), max(w.width_px for w in windows))
    nearest = torch.full((int(np.prod(shape)),), layout.empty, dtype=torch.int32, device=along.device)
    pixels = _pixels(along, windows, shape)
    nearest = nearest.scatter_reduce_(0, pixels.reshape(-1), keys.reshape(-1), "amin").reshape(shape)
    nearest = _squares(nearest, [splat_px(n, window, largest_splat_px) for window in windows]) - LEAST_KEY
    if points.colors is None:
        images = _shaded(nearest >> layout.index_bits, layout.levels)
    else:
        index = nearest & ((1 << layout.index_bits) - 1)
        images = points.colors.index_select(0, index.reshape(-1)).reshape(*shape, 3)
    on_cpu: np.ndarray = images.cpu().numpy()
    return on_cpu


def _to(values: np.ndarray, like: Any) -> Any:
    import torch

    return torch.tensor(values, device=like.device)


def _pixels(along: Any, windows: Sequence[Window], shape: tuple[int, int, int]) -> Any:
    """The pixel of each point in front and side view, (k, 2, n), counted row by row over all canvases."""
    import torch

    corner = np.array([w.origin_m - w.metres_per_px / 2 for w in windows]).astype(np.float32)
    scale = np.array([1 / w.metres_per_px for w in windows]).astype(np.float32)
    last = np.array([(w.width_px - 1, w.height_px - 1) for w in windows])
    left, top = (_to(corner[:, i].reshape(-1, 2, 1), along) for i in (0, 1))
    last_column, last_row = (_to(last[:, i].reshape(-1, 2, 1), along) for i in (0, 1))
    per_m = _to(scale.reshape(-1, 2, 1), along)
    # truncation rounds to the nearest pixel, since `corner` includes the half pixel and all values are at least 0
    right, down = torch.stack([along[:, 0], along[:, 2]], dim=1), along[:, 1:2]
    column = torch.minimum(((right - left) * per_m).to(torch.int64), last_column)
    row = torch.minimum(((down - top) * per_m).to(torch.int64), last_row)
    canvas = torch.arange(shape[0], device=along.device).reshape(-1, 2, 1) * (shape[1] * shape[2])
    return canvas + row * shape[2] + column


def _squares(nearest: Any, sides_px: Sequence[int]) -> Any:
    """Draws each point as a square of its view's size: the smallest key in each pixel's neighbourhood."""
    import torch

    for side in sorted(set(sides_px) - {1}):
        of_side = torch.tensor(np.flatnonzero(np.array(sides_px) == side), device=nearest.device)
        far_first = -nearest[of_side].view(torch.float32)[:, None]
        near_first = torch.nn.functional.max_pool2d(far_first, side, stride=1, padding=side // 2)
        nearest[of_side] = (-near_first[:, 0]).view(torch.int32)
    return nearest


def _shaded(level: Any, levels: int) -> Any:
    """Grey values by depth, near points light, (v, h, w, 3); the last level is the background."""
    import torch

    grey = (250 - 190 * (level.to(torch.float32) / levels)).to(torch.uint8)
    grey[level == levels] = BACKGROUND
    return grey[..., None].expand(*grey.shape, 3)
