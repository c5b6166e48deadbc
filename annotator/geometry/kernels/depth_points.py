"""The points of a depth image, and their colours."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from annotator.compiled import compiled


@compiled
def depth_points(
    depth: Float32[np.ndarray, "p"], x: Float32[np.ndarray, "p"], y: Float32[np.ndarray, "p"]
) -> tuple[Float32[np.ndarray, "n 3"], Int32[np.ndarray, "n"]]:
    """The point and the place of each pixel with a positive, finite depth and a ray.

    Args:
        depth: z of each pixel, metres.
        x, y: x/z and y/z of the ray of each pixel; x is NaN for a pixel without a ray.
    """
    count = 0
    for i in range(len(depth)):
        count += (depth[i] > 0) & (depth[i] < np.inf) & (x[i] == x[i])
    xyz = np.empty((count, 3), np.float32)
    index = np.empty(count, np.int32)
    k = 0
    for i in range(len(depth)):
        z = depth[i]
        if (z > 0) & (z < np.inf) & (x[i] == x[i]):
            xyz[k, 0], xyz[k, 1], xyz[k, 2] = x[i] * z, y[i] * z, z
            index[k] = i
            k += 1
    return xyz, index


@compiled
def colors_at(rgb: UInt8[np.ndarray, "p 3"], index: Int32[np.ndarray, "n"]) -> UInt8[np.ndarray, "n 3"]:
    """The colours of the pixels at these places."""
    colors = np.empty((len(index), 3), np.uint8)
    for k in range(len(index)):
        i = index[k]
        colors[k, 0], colors[k, 1], colors[k, 2] = rgb[i, 0], rgb[i, 1], rgb[i, 2]
    return colors
