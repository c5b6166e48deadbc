"""How many points lie between pairs of planes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from annotator.compiled import compiled


@compiled
def count_within(
    xyz: Float32[np.ndarray, "n 3"],
    frame: Float32[np.ndarray, "3 3"],
    low: Float32[np.ndarray, "3"],
    high: Float32[np.ndarray, "3"],
) -> tuple[int, int, int]:
    """How many points are between planes across a frame's axes.

    Args:
        xyz: points, row after row in memory.
        frame: rows = axes.
        low, high: where the planes are along the axes; points on them count.

    Returns:
        the points within all three pairs of planes, within the first two pairs, and within the last two.
    """
    # numbers, not places in memory: nothing in the loop can change them
    xx, xy, xz = frame[0, 0], frame[0, 1], frame[0, 2]
    yx, yy, yz = frame[1, 0], frame[1, 1], frame[1, 2]
    zx, zy, zz = frame[2, 0], frame[2, 1], frame[2, 2]
    low_x, low_y, low_z = low[0], low[1], low[2]
    high_x, high_y, high_z = high[0], high[1], high[2]
    every, first, last = 0, 0, 0
    # Steps through memory of a known length, and no `and`: so it becomes a loop of vector instructions.
    flat = xyz.reshape(-1)
    for i in range(len(xyz)):
        a, b, c = flat[3 * i], flat[3 * i + 1], flat[3 * i + 2]
        x, y, z = xx * a + xy * b + xz * c, yx * a + yy * b + yz * c, zx * a + zy * b + zz * c
        in_x, in_y, in_z = (x >= low_x) & (x <= high_x), (y >= low_y) & (y <= high_y), (z >= low_z) & (z <= high_z)
        every += in_x & in_y & in_z
        first += in_x & in_y
        last += in_y & in_z
    return every, first, last
