"""How well each of many rotations explains the lengths of measured intervals: the grid search of the box fit.

Half an interval's length along d is `sum_i s_i / 2 |d.r_i|`: linear in the sizes once the rotation is known, and free
of the centre. So each rotation is one least-squares problem with three unknowns, all are solved at once in closed form,
and the sizes are solved for again with each interval weighted by how well it fitted.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64

from annotator.rcv.config import FitConfig

# The share of the rotations that is looked at again: an interval that is wrong pulls at all of them alike at first.
AGAIN = 0.25
# Keeps the equations solvable while a direction is not measured at all.
RIDGE = 1e-6
# Below this share of the cubed trace a determinant is rounding.
LEAST_DETERMINANT = 1e-9


def reach_costs(
    directions: Float64[np.ndarray, "m 3"],
    ends_m: Float64[np.ndarray, "m 2"],
    sigma_m: Float64[np.ndarray, "m 2"],
    rotations: Float64[np.ndarray, "k 3 3"],
    config: FitConfig,
) -> Float64[np.ndarray, "k"]:
    """The robust cost of each rotation with its best sizes, in units of the expected variance; infinite for those that
    were not among the better ones after the first look.

    Args:
        directions, ends_m, sigma_m: as of `Intervals`; an interval with an unknown end does not count.
        rotations: columns = box axes in the frame of `directions`.
    """
    half = (ends_m[:, 1] - ends_m[:, 0]) / 2
    sigma = np.hypot(sigma_m[:, 0], sigma_m[:, 1]) / 2
    known = np.isfinite(sigma)
    # in multiples of the expected error, so that every weight begins at one
    scaled = directions[known] / sigma[known, None] / 2
    target = (half[known] / sigma[known]).astype(np.float32)[:, None]
    # (m, 3, k): what follows runs along the rotations
    reach = np.abs(scaled.astype(np.float32) @ rotations.astype(np.float32).transpose(1, 2, 0).reshape(3, -1))
    reach = reach.reshape(len(target), 3, len(rotations))
    least = np.float32(config.min_size_m)
    residual = _residual(reach, target, None, least)
    costs = np.full(len(rotations), np.inf)
    again = np.arange(len(rotations))
    first = _huber(residual, config.huber_sigmas)
    if len(rotations) * AGAIN > 16:
        again = np.argpartition(first, int(len(rotations) * AGAIN))[: int(len(rotations) * AGAIN)]
        reach, residual = np.ascontiguousarray(reach[:, :, again]), residual[:, again]
    weight = np.minimum(1.0, config.huber_sigmas / np.maximum(np.abs(residual), 1e-6)).astype(np.float32)
    costs[again] = _huber(_residual(reach, target, weight, least), config.huber_sigmas)
    return costs


def _huber(residual: Float32[np.ndarray, "m k"], delta: float) -> Float64[np.ndarray, "k"]:
    size = np.abs(residual)
    inner = np.minimum(size, np.float32(delta))
    return (inner * (size - 0.5 * inner)).sum(axis=0, dtype=np.float64)


def _residual(
    reach: Float32[np.ndarray, "m 3 k"],
    target: Float32[np.ndarray, "m 1"],
    weight: Float32[np.ndarray, "m k"] | None,
    least: np.float32,
) -> Float32[np.ndarray, "m k"]:
    """What is left of the target with each rotation's least-squares sizes, none below `least`."""
    x, y, z = reach[:, 0], reach[:, 1], reach[:, 2]
    wx, wy, wz = (x, y, z) if weight is None else (weight * x, weight * y, weight * z)
    pairs = ((wx, x), (wx, y), (wx, z), (wy, y), (wy, z), (wz, z))
    # Sums in single precision are exact enough to tell rotations apart; determinants of them would not be.
    xx, xy, xz, yy, yz, zz = (np.einsum("mk,mk->k", a, b).astype(np.float64) for a, b in pairs)
    bx, by, bz = (np.einsum("mk,m->k", a, target[:, 0]).astype(np.float64) for a in (wx, wy, wz))
    trace = xx + yy + zz
    xx, yy, zz = xx + RIDGE * trace, yy + RIDGE * trace, zz + RIDGE * trace
    # Cramer's rule for a symmetric matrix
    cx, cy, cz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    dy, dz, ez = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    determinant = xx * cx + xy * cy + xz * cz
    inverse = 1 / np.maximum(determinant, LEAST_DETERMINANT * trace**3 + np.finfo(np.float64).tiny)
    solved = (cx * bx + cy * by + cz * bz, cy * bx + dy * by + dz * bz, cz * bx + dz * by + ez * bz)
    sx, sy, sz = (np.maximum(row * inverse, least).astype(np.float32) for row in solved)
    return sx * x + sy * y + sz * z - target
