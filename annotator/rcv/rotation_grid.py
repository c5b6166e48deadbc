"""Rotations that a box can have, spread evenly, and which of them lie near each other: computed once."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial.transform import Rotation

from annotator.rcv.axes import BOX_SYMMETRIES

# How densely a search looks: steps of a computation, which decide nothing about an object.
GRID_SIZE = 400
YAW_GRID = 36

_IDENTITY = int(np.argmax(np.einsum("sii->s", BOX_SYMMETRIES)))


def turns(vectors: Float64[np.ndarray, "k 3"]) -> Float64[np.ndarray, "k 3 3"]:
    """Rotation matrices of rotation vectors, radians (Rodrigues); a few at once cost less here than in scipy."""
    angle = np.sqrt((vectors**2).sum(axis=1))
    half = 0.5 * angle
    # sin(x) / x and (1 - cos(x)) / x**2 in forms that are exact near zero
    by_cross, by_square = np.sinc(angle / np.pi), 0.5 * np.sinc(half / np.pi) ** 2
    cross = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -z, y, -x
    cross -= cross.swapaxes(1, 2)
    return np.eye(3) + by_cross[:, None, None] * cross + by_square[:, None, None] * (cross @ cross)


@lru_cache(maxsize=4)
def spread_rotations(count: int) -> Float64[np.ndarray, "k 3 3"]:
    """Rotations spread evenly over all that differ for a box, the identity first; the same every time.

    A super-Fibonacci spiral (Alexa, CVPR 2022) covers SO(3); of its members those are kept whose nearest box
    symmetry is the identity.
    """
    total = count * 24
    while True:
        rotations = _super_fibonacci(total)
        traces = np.einsum("sij,kji->ks", BOX_SYMMETRIES, rotations)
        own = traces[:, _IDENTITY] >= traces.max(axis=1) - 1e-12
        if own.sum() >= count - 1:
            kept = rotations[own]
            picked = kept[np.linspace(0, len(kept) - 1, count - 1).astype(int)] if count > 1 else kept[:0]
            return _fixed(np.concatenate([np.eye(3)[None], picked]))
        total = int(total * 1.2) + 1


def free_grid() -> Float64[np.ndarray, "k 3 3"]:
    """Rotations over all that differ for a box."""
    return spread_rotations(GRID_SIZE)


def yaw_grid(up: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "k 3 3"]:
    """Box rotations with z = up over a quarter turn: a half turn would repeat them with length and width swapped."""
    return _yaw_grid(tuple(up.tolist()))


@lru_cache(maxsize=16)
def _yaw_grid(up: tuple[float, ...]) -> Float64[np.ndarray, "k 3 3"]:
    z = np.array(up)
    helper = np.eye(3)[np.argmin(np.abs(z))]
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    base = np.stack([x, np.cross(z, x), z], axis=1)
    angles = np.arange(YAW_GRID) * (np.pi / 2 / YAW_GRID)
    return _fixed(Rotation.from_rotvec(angles[:, None] * z).as_matrix() @ base)


def grid_near(up: Float64[np.ndarray, "3"] | None, angle_rad: float) -> Bool[np.ndarray, "k k"]:
    """`near_each_other` of the grid for boxes held at `up` or, without it, of the free one; the answer is kept."""
    return _grid_near(None if up is None else tuple(up.tolist()), angle_rad)


@lru_cache(maxsize=16)
def _grid_near(up: tuple[float, ...] | None, angle_rad: float) -> Bool[np.ndarray, "k k"]:
    return _fixed(near_each_other(free_grid() if up is None else _yaw_grid(up), angle_rad))


def near_each_other(rotations: Float64[np.ndarray, "k 3 3"], angle_rad: float) -> Bool[np.ndarray, "k k"]:
    """Which rotations are less than an angle (radians) apart, those that turn a box into itself counted as equal."""
    # trace(A S B^T) for all pairs and symmetries: the columns of A, permuted and signed, against those of B
    flat = rotations.reshape(len(rotations), 9)
    best = np.full((len(rotations), len(rotations)), -np.inf)
    for symmetry in BOX_SYMMETRIES:
        np.maximum(best, (rotations @ symmetry).reshape(-1, 9) @ flat.T, out=best)
    return best > 1 + 2 * np.cos(angle_rad)


def distinct(costs: Float64[np.ndarray, "k"], near: Bool[np.ndarray, "k k"], count: int) -> Int64[np.ndarray, "c"]:
    """Indices of the `count` least costs, cheapest first, none near a cheaper one; fewer where there are no more."""
    left = costs.copy()
    chosen: list[int] = []
    while len(chosen) < count:
        index = int(np.argmin(left))
        if left[index] == np.inf:
            break
        chosen.append(index)
        left[near[index]] = np.inf
        left[index] = np.inf
    return np.array(chosen, np.int64)


def _super_fibonacci(n: int) -> Float64[np.ndarray, "n 3 3"]:
    phi, psi = np.sqrt(2.0), 1.533751168755204288118041
    s = np.arange(n) + 0.5
    r, big_r = np.sqrt(s / n), np.sqrt(1 - s / n)
    alpha, beta = 2 * np.pi * s / phi, 2 * np.pi * s / psi
    quaternions = np.stack([r * np.sin(alpha), r * np.cos(alpha), big_r * np.sin(beta), big_r * np.cos(beta)], axis=1)
    return Rotation.from_quat(quaternions, scalar_first=True).as_matrix()


def _fixed(values: np.ndarray) -> np.ndarray:
    """The array, read-only: it is shared."""
    values.flags.writeable = False
    return values
