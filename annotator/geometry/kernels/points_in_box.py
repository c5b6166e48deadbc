"""The test of points against a box."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from annotator.compiled import compiled


@compiled
def points_in_box(
    xyz: Float[np.ndarray, "n 3"],
    center: Float[np.ndarray, "3"],
    rotation: Float[np.ndarray, "3 3"],
    half: Float[np.ndarray, "3"],
) -> Bool[np.ndarray, "n"]:
    """Which points lie in a box or on its surface; NaN points are outside.

    Args:
        xyz: points, contiguous rows.
        center: of the box, in the points' frame; like all other arguments, with the dtype of the points.
        rotation: columns = box axes in that frame.
        half: half the lengths of the box.
    """
    inside = np.empty(len(xyz), np.bool_)
    # scalars, so that the compiler does not reload them in the loop
    cx, cy, cz = center[0], center[1], center[2]
    xx, yx, zx = rotation[0, 0], rotation[1, 0], rotation[2, 0]
    xy, yy, zy = rotation[0, 1], rotation[1, 1], rotation[2, 1]
    xz, yz, zz = rotation[0, 2], rotation[1, 2], rotation[2, 2]
    hx, hy, hz = half[0], half[1], half[2]
    # a constant stride, and `&` instead of `and`, so that the loop vectorises
    flat = xyz.reshape(-1)
    for i in range(len(xyz)):
        x, y, z = flat[3 * i] - cx, flat[3 * i + 1] - cy, flat[3 * i + 2] - cz
        inside[i] = (
            (abs(xx * x + yx * y + zx * z) <= hx)
            & (abs(xy * x + yy * y + zy * z) <= hy)
            & (abs(xz * x + yz * y + zz * z) <= hz)
        )
    return inside
