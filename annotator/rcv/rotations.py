"""Sets of rotations: the grid of the box fit's search with its costs, and the axis hypotheses of a consensus step.

Half the length of an interval along d is `sum_i s_i / 2 |d.r_i|`: linear in the sizes s_i for a known rotation with
axes r_i, and independent of the centre. Each rotation is therefore a least-squares problem with three unknowns, solved
in closed form. The best quarter is solved again with intervals weighted by their residuals (`fit_kernels.size_costs`).

The hypotheses are first spread widely, then close to the last fit. *Axes* are a (3, 3) matrix with rows a1, a2, a3, as
in `axes`.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial.transform import Rotation

from annotator.rcv.axes import BOX_SYMMETRIES, UPRIGHT_SYMMETRIES, camera_axes, match_all_axes

# Residual above which an edge is down-weighted (Huber), multiples of its expected error, and smallest side of a box.
HUBER_SIGMAS, MIN_SIZE_M = 1.5, 1e-3
# Resolution of the search. These are not settings, because they only trade accuracy against time.
GRID_SIZE = 400
YAW_GRID = 36
# Share of the rotations that are solved again, because a wrong interval distorts all costs of the first round.
SECOND_ROUND_SHARE = 0.25
# Grids up to this size are solved again as a whole.
SMALL_GRID = 64

_IDENTITY = int(np.argmax(np.einsum("sii->s", BOX_SYMMETRIES)))


def rotation_matrices(vectors: Float64[np.ndarray, "k 3"]) -> Float64[np.ndarray, "k 3 3"]:
    """Rotation matrices of rotation vectors, radians (Rodrigues); faster than scipy for a few vectors."""
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
    """`count` rotations spread evenly over all orientations of a box; deterministic, the identity first.

    A super-Fibonacci spiral (Alexa, CVPR 2022) covers SO(3). Only rotations whose nearest box symmetry is the identity
    are kept.
    """
    total = count * 24
    while True:
        rotations = _super_fibonacci(total)
        traces = np.einsum("sij,kji->ks", BOX_SYMMETRIES, rotations)
        near_identity = traces[:, _IDENTITY] >= traces.max(axis=1) - 1e-12
        if near_identity.sum() >= count - 1:
            distinct = rotations[near_identity]
            picked = distinct[np.linspace(0, len(distinct) - 1, count - 1).astype(int)] if count > 1 else distinct[:0]
            return _read_only(np.concatenate([np.eye(3)[None], picked]))
        total = int(total * 1.2) + 1


def free_grid() -> Float64[np.ndarray, "k 3 3"]:
    """The grid of rotations for free boxes."""
    return spread_rotations(GRID_SIZE)


def yaw_grid(up: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "k 3 3"]:
    """The grid of rotations for boxes with z = up, over a quarter turn.

    The next quarter turn repeats the same boxes with length and width swapped.
    """
    x = np.cross(np.eye(3)[np.argmin(np.abs(up))], up)
    x /= np.linalg.norm(x)
    base = np.stack([x, np.cross(up, x), up], axis=1)
    angles = np.arange(YAW_GRID) * (np.pi / 2 / YAW_GRID)
    return Rotation.from_rotvec(angles[:, None] * up).as_matrix() @ base


def grid_neighbours(up: Float64[np.ndarray, "3"] | None, angle_rad: float) -> Bool[np.ndarray, "k k"]:
    """`neighbours` of `yaw_grid(up)`, or of `free_grid()` if `up` is None; cached."""
    return _grid_neighbours(None if up is None else tuple(up.tolist()), angle_rad)


@lru_cache(maxsize=16)
def _grid_neighbours(up: tuple[float, ...] | None, angle_rad: float) -> Bool[np.ndarray, "k k"]:
    return _read_only(neighbours(free_grid() if up is None else yaw_grid(np.array(up)), angle_rad))


def neighbours(rotations: Float64[np.ndarray, "k 3 3"], angle_rad: float) -> Bool[np.ndarray, "k k"]:
    """Which rotations differ by less than `angle_rad`; rotations that map a box onto itself count as equal."""
    # trace(A S B^T) for all pairs and symmetries: the columns of A, permuted and signed, against those of B
    flat = rotations.reshape(len(rotations), 9)
    best = np.full((len(rotations), len(rotations)), -np.inf)
    for symmetry in BOX_SYMMETRIES:
        np.maximum(best, (rotations @ symmetry).reshape(-1, 9) @ flat.T, out=best)
    return best > 1 + 2 * np.cos(angle_rad)


def cheapest_distinct(
    costs: Float64[np.ndarray, "k"], near: Bool[np.ndarray, "k k"], count: int
) -> Int64[np.ndarray, "c"]:
    """Indices of up to `count` lowest finite costs, ascending, without neighbours of a cheaper rotation."""
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


def rotation_costs(
    directions: Float64[np.ndarray, "m 3"],
    ends_m: Float64[np.ndarray, "m 2"],
    sigma_m: Float64[np.ndarray, "m 2"],
    rotations: Float64[np.ndarray, "k 3 3"],
) -> Float64[np.ndarray, "k"]:
    """The robust cost of each rotation with its best sizes, in units of the expected variance.

    Rotations that are not among the best after the first round cost infinity.

    Args:
        directions, ends_m, sigma_m: as in `Intervals`; intervals with an unknown end are ignored.
        rotations: columns = box axes in the frame of `directions`.
    """
    from annotator.rcv.fit_kernels import size_costs

    half = (ends_m[:, 1] - ends_m[:, 0]) / 2
    sigma = np.hypot(sigma_m[:, 0], sigma_m[:, 1]) / 2
    known = np.isfinite(sigma)
    # in multiples of the expected error, so that all weights start at one
    scaled, target = directions[known] / sigma[known, None] / 2, half[known] / sigma[known]
    # copies, since numba compiles a second variant for read-only arrays
    if len(rotations) <= SMALL_GRID:
        return size_costs(scaled, target, rotations.copy(), HUBER_SIGMAS, MIN_SIZE_M, 2)
    costs = size_costs(scaled, target, rotations.copy(), HUBER_SIGMAS, MIN_SIZE_M, 1)
    again = np.argpartition(costs, int(len(costs) * SECOND_ROUND_SHARE))[: int(len(costs) * SECOND_ROUND_SHARE)]
    costs[:] = np.inf
    costs[again] = size_costs(scaled, target, rotations[again], HUBER_SIGMAS, MIN_SIZE_M, 2)
    return costs


def _super_fibonacci(n: int) -> Float64[np.ndarray, "n 3 3"]:
    phi, psi = np.sqrt(2.0), 1.533751168755204288118041
    s = np.arange(n) + 0.5
    r, big_r = np.sqrt(s / n), np.sqrt(1 - s / n)
    alpha, beta = 2 * np.pi * s / phi, 2 * np.pi * s / psi
    quaternions = np.stack([r * np.sin(alpha), r * np.cos(alpha), big_r * np.sin(beta), big_r * np.cos(beta)], axis=1)
    return Rotation.from_quat(quaternions, scalar_first=True).as_matrix()


def _read_only(values: np.ndarray) -> np.ndarray:
    """The same array, made read-only because the cache shares it."""
    values.flags.writeable = False
    return values


# Orientations of a wide step: over SO(3), or over a quarter turn of yaw.
FREE_HYPOTHESES, UPRIGHT_HYPOTHESES = 12, 4
# Rivals share the hypotheses of a wide step, but each has at least this number, or all.
LEAST_SHARE = 4
# Hypotheses of a refinement step, and their angle from the last fit; the same angle after a warm start.
REFINE_HYPOTHESES, REFINE_SPREAD_RAD = 3, 0.35
# Of the four diagonals of a cube, as many as there are hypotheses.
DIAGONALS = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1]]) / np.sqrt(3.0)


def wide_axes(up: Float64[np.ndarray, "3"] | None, rivals: int = 1) -> list[Float64[np.ndarray, "3 3"]]:
    """Axes spread over all orientations of a box: over a quarter turn of yaw with `up`, else over SO(3).

    Args:
        rivals: number of states of the same object that share the hypotheses.
    """
    base = camera_axes(up)
    count = FREE_HYPOTHESES if up is None else UPRIGHT_HYPOTHESES
    count = min(count, max(count // rivals, LEAST_SHARE))
    if up is not None:
        yaws = np.arange(count) * (np.pi / 2 / count)
        rotations = Rotation.from_rotvec(yaws[:, None] * up).as_matrix()
    else:
        rotations = spread_rotations(count)
    return _all_facing_camera(base @ rotations.swapaxes(1, 2), up)


def near_axes(
    rotation: Float64[np.ndarray, "3 3"], up: Float64[np.ndarray, "3"] | None
) -> list[Float64[np.ndarray, "3 3"]]:
    """The axes of a box rotation (columns = axes), and others up to `REFINE_SPREAD_RAD` away.

    More views along a box's own axes hardly improve a fit; views from slightly other directions determine its rotation.
    """
    if up is not None:
        offsets = np.linspace(-REFINE_SPREAD_RAD, REFINE_SPREAD_RAD, REFINE_HYPOTHESES)[:, None] * up
    else:
        offsets = np.concatenate([np.zeros((1, 3)), REFINE_SPREAD_RAD * _fibonacci_directions(REFINE_HYPOTHESES - 1)])
    return _all_facing_camera((Rotation.from_rotvec(offsets).as_matrix() @ rotation).swapaxes(1, 2), up)


def warm_axes(
    rotation: Float64[np.ndarray, "3 3"], up: Float64[np.ndarray, "3"] | None, step: int
) -> list[Float64[np.ndarray, "3 3"]]:
    """Axes around a nearly correct rotation, which determine a box without a previous wide step.

    In views along a free box's own axes, its extent is the same for a small rotation in either direction. If a view is
    rotated about a diagonal, the extent along each of its axes depends on two rotations. So the hypotheses are rotated
    about the diagonals, and in the opposite direction in the next step. An upright box gets `near_axes`.

    Args:
        rotation: columns = box axes.
    """
    if up is not None:
        return near_axes(rotation, up)
    angle_rad = REFINE_SPREAD_RAD if step % 2 == 0 else -REFINE_SPREAD_RAD
    turned = rotation @ rotation_matrices(angle_rad * DIAGONALS)
    return _all_facing_camera(turned.swapaxes(1, 2), up)


def face_camera(axes: Float64[np.ndarray, "3 3"], up: Float64[np.ndarray, "3"] | None) -> Float64[np.ndarray, "3 3"]:
    """The relabelling of axes that is nearest to the camera's axes; level if `up` is given.

    Every object is then viewed from the sensor's side and the right way up, independent of the labelling of its axes.
    """
    return _all_facing_camera(axes[None], up)[0]


def _all_facing_camera(
    axes: Float64[np.ndarray, "k 3 3"], up: Float64[np.ndarray, "3"] | None
) -> list[Float64[np.ndarray, "3 3"]]:
    reference = camera_axes(up)
    matched = match_all_axes(axes, reference)
    return list(matched if up is None else match_all_axes(matched, reference, UPRIGHT_SYMMETRIES))


def _fibonacci_directions(count: int) -> Float64[np.ndarray, "k 3"]:
    """Unit vectors spread evenly over the sphere (Fibonacci lattice)."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = np.pi * (1 + np.sqrt(5.0)) * index
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
