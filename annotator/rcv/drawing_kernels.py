"""Extents of points along many axes, and the rendering of many views at once.

Inner loops run over slices in separate functions, because only then can the compiler rule out negative indices and
vectorise the loops.
"""

from __future__ import annotations

import numpy as np

from annotator.compiled import compiled

# Points per block: the intermediate arrays fit into the L1 cache.
BLOCK = 512


@compiled
def extents(xyz: np.ndarray, axes: np.ndarray, least: np.ndarray, most: np.ndarray) -> None:
    """Smallest and largest coordinate of points along the rows of several axes.

    Args:
        xyz: (3, n) float32, n >= 1.
        axes: (k, 3, 3) float32.
        least, most: (k, 3) float32, output.
    """
    n = xyz.shape[1]
    # one running extreme per position in a block, so that the loop over a block vectorises
    low, high = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    for k in range(axes.shape[0]):
        for row in range(3):
            axis = axes[k, row]
            low[:] = np.inf
            high[:] = -np.inf
            for begin in range(0, n, BLOCK):
                end = min(begin + BLOCK, n)
                _widen(xyz[0, begin:end], xyz[1, begin:end], xyz[2, begin:end], axis, low, high)
            least[k, row] = low.min()
            most[k, row] = high.max()


@compiled
def _widen(x: np.ndarray, y: np.ndarray, z: np.ndarray, axis: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    a, b, c = axis[0], axis[1], axis[2]
    for j in range(len(x)):
        along = a * x[j] + b * y[j] + c * z[j]
        low[j] = along if along < low[j] else low[j]
        high[j] = along if along > high[j] else high[j]


@compiled
def draw_views(
    xyz: np.ndarray,
    packed: np.ndarray,
    axes: np.ndarray,
    sizes: np.ndarray,
    places: np.ndarray,
    depths: np.ndarray,
    splats: np.ndarray,
    bits: np.ndarray,
    begins: np.ndarray,
    images: np.ndarray,
) -> None:
    """Draws all views of a cloud; `annotator.rcv.pseudo_view` explains the method.

    Args:
        xyz: (3, n) float32.
        packed: (n + 1,) uint32 colours, the background last; or (1,) to shade by depth.
        axes: (v, 3, 3) float32, rows right, down, into the image.
        sizes: (v, 2) int64 width and height, pixels.
        places: (v, 3) float32 left and top edge, metres, and pixels per metre.
        depths: (v, 2) float32 the nearest point's depth, metres, and levels per metre.
        splats: (v,) int64 side of a point's square, odd, pixels.
        bits: (4,) int64: bits of a point's index, number of levels, smallest key, and the background's grey.
        begins: (v,) int64 offset of each image in `images`.
        images: uint32 colours, row by row; output.
    """
    n = xyz.shape[1]
    empty = np.uint32(bits[2] + (bits[1] << bits[0]) + n)
    largest = 0
    for v in range(axes.shape[0]):
        largest = max(largest, sizes[v, 0] * sizes[v, 1])
    all_nearest, all_spread = np.empty(largest, np.uint32), np.empty(largest, np.uint32)
    pixels, keys = np.empty(BLOCK, np.uint32), np.empty(BLOCK, np.uint32)
    for v in range(axes.shape[0]):
        width, height = sizes[v, 0], sizes[v, 1]
        nearest = all_nearest[: width * height]
        nearest[:] = empty
        # rounding can move the outermost points out of the window or the depth range; they are clamped to it
        last = (np.float32(width - 1), np.float32(height - 1), np.float32(bits[1] - 1))
        for begin in range(0, n, BLOCK):
            end = min(begin + BLOCK, n)
            x, y, z = xyz[0, begin:end], xyz[1, begin:end], xyz[2, begin:end]
            _project(x, y, z, axes[v], places[v], depths[v], last, width, bits[0], bits[2] + begin, pixels, keys)
            _keep_nearest(pixels[: end - begin], keys, nearest)
        if splats[v] > 1:
            spread = all_spread[: width * height]
            _widen_rows(nearest.reshape(height, width), spread.reshape(height, width), splats[v] // 2)
            _widen_columns(spread.reshape(height, width), nearest.reshape(height, width), splats[v] // 2)
        image = images[begins[v] : begins[v] + width * height]
        if len(packed) > 1:
            _colour(nearest, packed, bits[2], (1 << bits[0]) - 1, image)
        else:
            _shade(nearest, bits[0], bits[1], bits[2], bits[3], image)


@compiled
def _project(
    x: np.ndarray,
    y: np.ndarray,
    z: np.ndarray,
    axes: np.ndarray,
    place: np.ndarray,
    depth: np.ndarray,
    last: tuple[np.float32, np.float32, np.float32],
    width: int,
    index_bits: int,
    first_key: int,
    pixels: np.ndarray,
    keys: np.ndarray,
) -> None:
    """Fills in the pixel of each point, counted row by row, and its key."""
    rx, ry, rz = axes[0, 0], axes[0, 1], axes[0, 2]
    dx, dy, dz = axes[1, 0], axes[1, 1], axes[1, 2]
    ix, iy, iz = axes[2, 0], axes[2, 1], axes[2, 2]
    left, top, per_m = place[0], place[1], place[2]
    near, levels_per_m = depth[0], depth[1]
    last_column, last_row, last_level = last
    zero = np.float32(0.0)
    for j in range(len(x)):
        # truncation rounds to the nearest pixel: the half is part of `place`, and negative values are clamped
        column = (rx * x[j] + ry * y[j] + rz * z[j] - left) * per_m
        row = (dx * x[j] + dy * y[j] + dz * z[j] - top) * per_m
        level = (ix * x[j] + iy * y[j] + iz * z[j] - near) * levels_per_m
        column = column if column > zero else zero
        column = column if column < last_column else last_column
        row = row if row > zero else zero
        row = row if row < last_row else last_row
        level = level if level > zero else zero
        level = level if level < last_level else last_level
        pixels[j] = np.int32(row) * width + np.int32(column)
        keys[j] = (np.int32(level) << index_bits) + first_key + j


@compiled
def _keep_nearest(pixels: np.ndarray, keys: np.ndarray, nearest: np.ndarray) -> None:
    for j in range(len(pixels)):
        pixel, key = pixels[j], keys[j]
        if key < nearest[pixel]:
            nearest[pixel] = key


@compiled
def _widen_rows(keys: np.ndarray, spread: np.ndarray, radius: int) -> None:
    """The smallest key of each pixel and its neighbours to the left and right."""
    height, width = keys.shape
    reach = min(radius, width - 1)
    for row in range(height):
        spread[row] = keys[row]
        for step in range(1, reach + 1):
            _lower(spread[row, : width - step], keys[row, step:])
            _lower(spread[row, step:], keys[row, : width - step])


@compiled
def _widen_columns(keys: np.ndarray, spread: np.ndarray, radius: int) -> None:
    """The smallest key of each pixel and its neighbours above and below."""
    height = len(keys)
    for row in range(height):
        spread[row] = keys[row]
        for other in range(max(row - radius, 0), min(row + radius, height - 1) + 1):
            _lower(spread[row], keys[other])


@compiled
def _lower(keys: np.ndarray, others: np.ndarray) -> None:
    for i in range(len(keys)):
        keys[i] = others[i] if others[i] < keys[i] else keys[i]


@compiled
def _colour(nearest: np.ndarray, packed: np.ndarray, least_key: int, index_mask: int, image: np.ndarray) -> None:
    """The colours of the nearest points."""
    for i in range(len(nearest)):
        image[i] = packed[np.uint32((nearest[i] - least_key) & index_mask)]


@compiled
def _shade(
    nearest: np.ndarray, index_bits: int, levels: int, least_key: int, background: int, image: np.ndarray
) -> None:
    """Grey values by depth, near points light; the last level is reserved for the background."""
    for i in range(len(nearest)):
        level = (nearest[i] - least_key) >> index_bits
        grey = np.int32(np.float32(250.0) - np.float32(190.0) * (np.float32(level) / np.float32(levels)))
        grey = grey if level < levels else np.int32(background)
        image[i] = (grey << 16) | (grey << 8) | grey
