"""Robust least-squares sizes of a box, and their costs, for each of many rotations.

Every inner loop runs along the rotations and writes one array, so that it vectorises.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from annotator.compiled import compiled

# Keeps the equations solvable if a direction is not measured at all.
RIDGE = 1e-6
# Below this share of the cubed trace, a determinant is rounding error.
LEAST_DETERMINANT = 1e-9


@compiled
def size_costs(
    scaled: Float64[np.ndarray, "m 3"],
    target: Float64[np.ndarray, "m"],
    rotations: Float64[np.ndarray, "k 3 3"],
    delta: float,
    least: float,
    rounds: int,
) -> Float64[np.ndarray, "k"]:
    """The robust cost of each rotation with the sizes that fit the intervals' lengths best.

    Args:
        scaled: directions divided by twice the expected error of half an interval, per metre.
        target: half the intervals' lengths divided by that error.
        rotations: columns = box axes in the frame of the directions.
        delta: residual above which Huber's cost is linear.
        least: lower bound of the sizes, metres.
        rounds: number of solutions for the sizes: the first with weights of one, the others with Huber's weights.
    """
    m, k, turned = len(target), len(rotations), rotations.transpose(1, 2, 0).copy()
    reach, weighted, sizes, sums = np.empty((3, k)), np.empty((3, k)), np.empty((3, k)), np.empty((9, k))
    residual, cost, weight = np.empty(k), np.zeros(k), np.ones((m, k))
    for done in range(rounds):
        sums[:] = 0.0
        cost[:] = 0.0
        for i in range(m):
            _reach(scaled[i], turned, reach)
            place = 0
            for a in range(3):
                for j in range(k):
                    weighted[a, j] = weight[i, j] * reach[a, j]
                for j in range(k):
                    sums[6 + a, j] += target[i] * weighted[a, j]
                for b in range(a + 1):
                    for j in range(k):
                        sums[place, j] += weighted[a, j] * reach[b, j]
                    place += 1
        _solve(sums, least, sizes)
        for i in range(m):
            _reach(scaled[i], turned, reach)
            for j in range(k):
                predicted = sizes[0, j] * reach[0, j] + sizes[1, j] * reach[1, j] + sizes[2, j] * reach[2, j]
                residual[j] = abs(predicted - target[i])
            for j in range(k):
                inner = min(residual[j], delta)
                cost[j] += inner * (residual[j] - 0.5 * inner)
            if done + 1 == rounds:
                continue
            for j in range(k):
                weight[i, j] = min(1.0, delta / max(residual[j], 1e-6))
    return cost


@compiled
def _reach(direction: np.ndarray, turned: np.ndarray, reach: np.ndarray) -> None:
    """Fills in the derivatives (3, k) of the extent along a direction with respect to the sizes.

    Args:
        turned: (3, 3, k) rotations.
    """
    x, y, z = direction
    for a in range(3):
        for j in range(turned.shape[2]):
            reach[a, j] = abs(x * turned[0, a, j] + y * turned[1, a, j] + z * turned[2, a, j])


@compiled
def _solve(sums: np.ndarray, least: float, sizes: np.ndarray) -> None:
    """Fills in the sizes (3, k) by Cramer's rule; `sums` holds a symmetric matrix's lower triangle and right side."""
    for j in range(sums.shape[1]):
        xx, xy, yy, xz, yz, zz, bx, by, bz = sums[:, j]
        trace = xx + yy + zz
        xx, yy, zz = xx + RIDGE * trace, yy + RIDGE * trace, zz + RIDGE * trace
        cx, cy, cz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
        dy, dz, ez = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
        determinant = xx * cx + xy * cy + xz * cz
        # the last term avoids a division by zero if nothing is measured
        inverse = 1.0 / max(determinant, LEAST_DETERMINANT * trace**3 + 1e-300)
        sizes[0, j] = max((cx * bx + cy * by + cz * bz) * inverse, least)
        sizes[1, j] = max((cy * bx + dy * by + dz * bz) * inverse, least)
        sizes[2, j] = max((cz * bx + dz * by + ez * bz) * inverse, least)
