"""One oriented box from many measured intervals: the fit behind the consensus strategy.

A view along a known direction measures, for each direction d in its plane, the interval of the object on d. For a box
with centre c, axes r_i and sizes s_i that interval is `d.c -/+ sum_i s_i / 2 |d.r_i|` (DESIGN: a few directions
over-determine the 5 unknowns of an upright and the 9 of a free box). For a given orientation both ends are linear in c
and s; so orientations are searched on a grid, and the best ones refined by robust Gauss-Newton steps on everything.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from annotator.rcv.axes import BOX_SYMMETRIES
from annotator.rcv.config import FitConfig

# How densely the search looks and how long it refines: steps of a computation, which decide nothing about an object.
GRID_SIZE = 400
YAW_GRID = 36
STARTS = 6
START_DISTANCE_RAD = float(np.deg2rad(10))
REFINE_ROUNDS = 12
# Keeps the normal equations solvable while a direction is not measured at all; such a fit is refused in the end.
RIDGE = 1e-6

DEFAULTS = FitConfig()


@dataclass(frozen=True)
class Intervals:
    """m measured intervals.

    Attributes:
        directions: (m, 3) unit vectors, camera frame.
        ends_m: (m, 2) low and high end along the direction, metres.
        sigma_m: (m, 2) expected error of each end, metres; infinite where the picture cut it off.
    """

    directions: Float64[np.ndarray, "m 3"]
    ends_m: Float64[np.ndarray, "m 2"]
    sigma_m: Float64[np.ndarray, "m 2"]

    @staticmethod
    def concatenate(parts: list[Intervals]) -> Intervals:
        return Intervals(
            np.concatenate([p.directions for p in parts]),
            np.concatenate([p.ends_m for p in parts]),
            np.concatenate([p.sigma_m for p in parts]),
        )


@dataclass(frozen=True)
class BoxFit:
    """A fitted box.

    Attributes:
        center_m, rotation, size_m: the box; columns of `rotation` are its axes in the camera frame.
        cost: robust cost, in units of the expected variance.
        residual_m: robust spread of the ends around the fit, metres.
    """

    center_m: Float64[np.ndarray, "3"]
    rotation: Float64[np.ndarray, "3 3"]
    size_m: Float64[np.ndarray, "3"]
    cost: float
    residual_m: float


def fit_box(
    intervals: Intervals,
    up: Float64[np.ndarray, "3"] | None,
    near: np.ndarray | None = None,
    config: FitConfig = DEFAULTS,
) -> BoxFit | None:
    """The box that explains the intervals best; None where they do not fix one.

    Args:
        up: holds the box's z axis at this unit vector; None leaves the rotation free.
        near: (3, 3) box rotation to try besides the grid, such as the last step's.
    """
    problem = _Edges.of(intervals, config)
    if problem.count < (7 if up is not None else 9):
        return None
    rotations = _yaw_grid(up) if up is not None else _free_grid()
    if near is not None:
        rotations = np.concatenate([rotations, near[None]])
    costs = problem.linear(rotations, rounds=2).cost
    starts = rotations[_distinct_best(rotations, costs, STARTS)]
    fits = problem.refine(starts, up)
    best = int(np.argmin(fits.cost))
    if not np.isfinite(fits.cost[best]) or (fits.size[best] <= config.min_size_m).any():
        return None
    if not problem.fixes(fits.rotation[best : best + 1], fits.size[best : best + 1], up):
        return None
    residual = problem.residuals(
        fits.center[best : best + 1], fits.rotation[best : best + 1], fits.size[best : best + 1]
    )
    spread = 1.4826 * float(np.median(np.abs(residual)))
    return BoxFit(
        fits.center[best] + problem.shift, fits.rotation[best], fits.size[best], float(fits.cost[best]), spread
    )


@dataclass(frozen=True)
class _Solutions:
    center: np.ndarray  # (k, 3)
    rotation: np.ndarray  # (k, 3, 3)
    size: np.ndarray  # (k, 3)
    cost: np.ndarray  # (k,)


@dataclass(frozen=True)
class _Edges:
    """Each finite end as one equation `d.c + sign sum_i s_i / 2 |d.r_i| = value`, centred for precision."""

    direction: np.ndarray  # (e, 3)
    sign: np.ndarray  # (e,) -1 low, +1 high
    value: np.ndarray  # (e,)
    sigma: np.ndarray  # (e,)
    shift: np.ndarray  # (3,) what was subtracted from all positions
    config: FitConfig

    @classmethod
    def of(cls, intervals: Intervals, config: FitConfig) -> _Edges:
        finite = np.isfinite(intervals.sigma_m)
        middle = intervals.ends_m.mean(axis=1)
        shift = np.linalg.lstsq(intervals.directions, middle, rcond=None)[0]
        direction = np.repeat(intervals.directions[:, None], 2, axis=1)[finite]
        sign = np.broadcast_to(np.array([-1.0, 1.0]), finite.shape)[finite]
        value = intervals.ends_m[finite] - direction @ shift
        return cls(direction, sign, value, intervals.sigma_m[finite], shift, config)

    @property
    def count(self) -> int:
        return len(self.value)

    def residuals(self, center: np.ndarray, rotation: np.ndarray, size: np.ndarray) -> np.ndarray:
        """(k, e) predicted minus measured, metres."""
        reach = np.abs(self.direction @ rotation) @ size[:, :, None] / 2
        return center @ self.direction.T + self.sign * reach[:, :, 0] - self.value

    def weights(self, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Huber weights (k, e) and costs (k,) of residuals."""
        scaled, delta = np.abs(residual) / self.sigma, self.config.huber_sigmas
        weight = np.minimum(1.0, delta / np.maximum(scaled, 1e-12)) / self.sigma**2
        cost = np.where(scaled <= delta, 0.5 * scaled**2, delta * (scaled - 0.5 * delta))
        return weight, cost.sum(axis=1)

    def linear(self, rotation: np.ndarray, rounds: int) -> _Solutions:
        """Centre and size by reweighted least squares for fixed rotations (k, 3, 3)."""
        k = len(rotation)
        design = np.empty((k, self.count, 6))
        design[:, :, :3] = self.direction
        design[:, :, 3:] = self.sign[:, None] * np.abs(self.direction @ rotation) / 2
        weight = np.broadcast_to(1 / self.sigma**2, (k, self.count))
        cost = np.full(k, np.inf)
        solution = np.zeros((k, 6))
        for _ in range(rounds):
            solution = _solve(design, weight, np.broadcast_to(self.value, (k, self.count)))
            solution[:, 3:] = np.maximum(solution[:, 3:], self.config.min_size_m)
            weight, cost = self.weights((design @ solution[:, :, None])[:, :, 0] - self.value)
        return _Solutions(solution[:, :3], rotation, solution[:, 3:], cost)

    def refine(self, rotation: np.ndarray, up: np.ndarray | None) -> _Solutions:
        """Damped Gauss-Newton from several starts (k, 3, 3) at once over centre, size and rotation."""
        start = self.linear(rotation, rounds=3)
        center, size, cost = start.center, start.size, start.cost
        damping = np.full(len(rotation), 1e-3)
        turns = 1 if up is not None else 3
        for _ in range(REFINE_ROUNDS):
            residual = self.residuals(center, rotation, size)
            weight, cost = self.weights(residual)
            jacobian = self._jacobian(rotation, size, up)
            step = _solve(jacobian, weight, -residual, damping)
            new_center = center + step[:, :3]
            new_size = np.maximum(size + step[:, 3:6], self.config.min_size_m)
            vector = step[:, 6 : 6 + turns] * up if up is not None else step[:, 6:9]
            new_rotation = Rotation.from_rotvec(vector).as_matrix() @ rotation
            _, new_cost = self.weights(self.residuals(new_center, new_rotation, new_size))
            better = new_cost < cost
            center = np.where(better[:, None], new_center, center)
            size = np.where(better[:, None], new_size, size)
            rotation = np.where(better[:, None, None], new_rotation, rotation)
            cost = np.where(better, new_cost, cost)
            damping = np.where(better, damping / 4, damping * 10)
        return _Solutions(center, rotation, size, cost)

    def fixes(self, rotation: np.ndarray, size: np.ndarray, up: np.ndarray | None) -> bool:
        """Whether the equations hold all unknowns of a box (1, 3, 3), (1, 3), and not only some of them."""
        jacobian = self._jacobian(rotation, size, up)[0] / self.sigma[:, None]
        scale = np.linalg.norm(jacobian, axis=0)
        if (scale == 0).any():
            return False
        return bool(np.linalg.svd(jacobian / scale, compute_uv=False)[-1] > self.config.min_determinacy)

    def _jacobian(self, rotation: np.ndarray, size: np.ndarray, up: np.ndarray | None) -> np.ndarray:
        """(k, e, 7 or 9) derivative of the residuals by centre, size and rotation (about camera axes, or `up`)."""
        along = self.direction @ rotation
        slope = self.sign[:, None] * np.sign(along) * size[:, None, :] / 2
        # d . (w x r_i) = w . (r_i x d), summed over the box's axes
        turned = np.cross(np.swapaxes(rotation, 1, 2)[:, None, :, :], self.direction[None, :, None, :])
        by_turn = np.einsum("kei,keij->kej", slope, turned)
        if up is not None:
            by_turn = by_turn @ up[:, None]
        center = np.broadcast_to(self.direction, (len(rotation), *self.direction.shape))
        return np.concatenate([center, self.sign[:, None] * np.abs(along) / 2, by_turn], axis=2)


def _solve(design: np.ndarray, weight: np.ndarray, target: np.ndarray, damping: np.ndarray | None = None) -> np.ndarray:
    """Weighted least squares of k problems (k, e, p) by normal equations, with Levenberg's damping where given."""
    weighted = design * weight[:, :, None]
    normal = np.swapaxes(weighted, 1, 2) @ design
    scale = np.einsum("kii->ki", normal)
    ridge = RIDGE * scale.mean(axis=1, keepdims=True)
    extra = ridge if damping is None else ridge + damping[:, None] * scale
    normal = normal + np.eye(design.shape[2]) * extra[:, None, :]
    return np.linalg.solve(normal, np.swapaxes(weighted, 1, 2) @ target[:, :, None])[:, :, 0]


def _distinct_best(rotations: np.ndarray, costs: np.ndarray, count: int) -> np.ndarray:
    """Indices of the best rotations that are at least `START_DISTANCE_RAD` apart, box symmetries counted as equal."""
    chosen: list[int] = []
    limit = 1 + 2 * np.cos(START_DISTANCE_RAD)
    for index in np.argsort(costs, kind="stable"):
        relative = np.einsum("sij,mjl->smil", BOX_SYMMETRIES, rotations[chosen].swapaxes(1, 2)) if chosen else None
        if relative is not None:
            trace = np.einsum("smil,li->sm", relative, rotations[index])
            if trace.max() > limit:
                continue
        chosen.append(int(index))
        if len(chosen) == count:
            break
    return np.array(chosen)


def _yaw_grid(up: np.ndarray) -> Float64[np.ndarray, "k 3 3"]:
    """Box rotations with z = up over a quarter turn: a half turn would repeat them with length and width swapped."""
    helper = np.eye(3)[np.argmin(np.abs(up))]
    x = np.cross(helper, up)
    x /= np.linalg.norm(x)
    base = np.stack([x, np.cross(up, x), up], axis=1)
    angles = np.arange(YAW_GRID) * (np.pi / 2 / YAW_GRID)
    return Rotation.from_rotvec(angles[:, None] * up).as_matrix() @ base


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
            result = np.concatenate([np.eye(3)[None], picked])
            result.flags.writeable = False
            return result
        total = int(total * 1.2) + 1


_IDENTITY = int(np.argmax(np.einsum("sii->s", BOX_SYMMETRIES)))


def _super_fibonacci(n: int) -> Float64[np.ndarray, "n 3 3"]:
    phi, psi = np.sqrt(2.0), 1.533751168755204288118041
    s = np.arange(n) + 0.5
    r, big_r = np.sqrt(s / n), np.sqrt(1 - s / n)
    alpha, beta = 2 * np.pi * s / phi, 2 * np.pi * s / psi
    quaternions = np.stack([r * np.sin(alpha), r * np.cos(alpha), big_r * np.sin(beta), big_r * np.cos(beta)], axis=1)
    return Rotation.from_quat(quaternions, scalar_first=True).as_matrix()


def _free_grid() -> Float64[np.ndarray, "k 3 3"]:
    return spread_rotations(GRID_SIZE)
