"""Counts of points between pairs of planes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from annotator.compiled import compiled


@compiled
def count_within(
    xyz: Float32[np.ndarray, "n 3"],
    axes: Float32[np.ndarray, "3 3"],
    low: Float32[np.ndarray, "3"],
    high: Float32[np.ndarray, "3"],
) -> tuple[int, int, int]:
    """Counts the points between pairs of planes perpendicular to given axes.

    Args:
        xyz: points, contiguous rows.
        axes: rows = a1, a2, a3.
        low, high: positions of the planes along the axes; points on a plane count.

    Returns:
        the numbers of points within all three pairs of planes, within the first two pairs, and within the last two.
    """
    # scalars, so that the compiler does not reload them in the loop
    xx, xy, xz = axes[0, 0], axes[0, 1], axes[0, 2]
    yx, yy, yz = axes[1, 0], axes[1, 1], axes[1, 2]
    zx, zy, zz = axes[2, 0], axes[2, 1], axes[2, 2]
    low_x, low_y, low_z = low[0], low[1], low[2]
    high_x, high_y, high_z = high[0], high[1], high[2]
    every, first, last = 0, 0, 0
    # a constant stride, and `&` instead of `and`, so that the loop vectorises
    flat = xyz.reshape(-1)
    for i in range(len(xyz)):
        a, b, c = flat[3 * i], flat[3 * i + 1], flat[3 * i + 2]
        x, y, z = xx * a + xy * b + xz * c, yx * a + yy * b + yz * c, zx * a + zy * b + zz * c
        in_x, in_y, in_z = (x >= low_x) & (x <= high_x), (y >= low_y) & (y <= high_y), (z >= low_z) & (z <= high_z)
        every += in_x & in_y & in_z
        first += in_x & in_y
        last += in_y & in_z
    return every, first, last
