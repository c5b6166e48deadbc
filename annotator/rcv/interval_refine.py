"""The refinement of a box through measured intervals: damped Gauss-Newton from several rotations at once.

Both ends of an interval share one direction, so all is written in terms of the m directions: with the middle `d.c` and
the reach `sum_i s_i / 2 |d.r_i|`, the low end is their difference and the high end their sum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from annotator.rcv.config import FitConfig
from annotator.rcv.rotation_grid import turns

# How long it refines: steps of a computation, which decide nothing about an object.
ROUNDS = 12
# After so many rounds only the best few are refined further.
FIRST_ROUNDS, SURVIVORS = 4, 2
# A round that lowers no cost by this share is the last.
SETTLED = 1e-5
# Keeps the normal equations solvable while a direction is not measured at all; such a fit is refused in the end.
RIDGE = 1e-6


@dataclass(frozen=True)
class Solution:
    """A box and its robust cost, in units of the expected variance; columns of `rotation` are its axes."""

    center_m: Float64[np.ndarray, "3"]
    rotation: Float64[np.ndarray, "3 3"]
    size_m: Float64[np.ndarray, "3"]
    cost: float


@dataclass(frozen=True)
class Edges:
    """The ends of m intervals, centred for precision.

    Attributes:
        direction: (m, 3) unit vectors.
        ends: (m, 2) low and high end, metres from `shift`; 0 where unknown.
        inverse: (m, 2) one over the expected error; 0 where unknown.
        shift: (3,) what was subtracted from all positions.
        config: settings.
    """

    direction: Float64[np.ndarray, "m 3"]
    ends: Float64[np.ndarray, "m 2"]
    inverse: Float64[np.ndarray, "m 2"]
    shift: Float64[np.ndarray, "3"]
    config: FitConfig

    @classmethod
    def of(
        cls,
        direction: Float64[np.ndarray, "m 3"],
        ends_m: Float64[np.ndarray, "m 2"],
        sigma_m: Float64[np.ndarray, "m 2"],
        config: FitConfig,
    ) -> Edges:
        """The ends of `Intervals`; an infinite error is an unknown end."""
        known = np.isfinite(sigma_m)
        shift = np.linalg.lstsq(direction, np.where(known, ends_m, 0.0).mean(axis=1), rcond=None)[0]
        ends = np.where(known, ends_m - (direction @ shift)[:, None], 0.0)
        return cls(direction, ends, 1 / sigma_m, shift, config)

    def residuals(self, fit: Solution) -> Float64[np.ndarray, "m 2"]:
        """Predicted minus measured ends, metres."""
        reach = np.abs(self.direction @ fit.rotation) @ fit.size_m / 2
        middle = self.direction @ (fit.center_m - self.shift)
        return np.stack([middle - reach, middle + reach], axis=1) - self.ends

    def fixes(self, fit: Solution, held: bool) -> bool:
        """Whether the equations hold all unknowns of a box, and not only some of them; see `refine` for `held`."""
        along = self.direction @ fit.rotation
        reach = _by_size_and_turn(along[None], fit.size_m[None], held)[0]
        low = np.concatenate([self.direction, -reach], axis=1) * self.inverse[:, :1]
        high = np.concatenate([self.direction, reach], axis=1) * self.inverse[:, 1:]
        jacobian = np.concatenate([low, high])
        scale = np.sqrt((jacobian**2).sum(axis=0))
        if (scale == 0).any():
            return False
        return bool(np.linalg.svd(jacobian / scale, compute_uv=False)[-1] > self.config.min_determinacy)

    def refine(self, rotation: Float64[np.ndarray, "k 3 3"], held: bool) -> Solution:
        """The best box that steps from any of several rotations lead to.

        Args:
            rotation: where to start; columns = box axes.
            held: turn about the boxes' z axes only.
        """
        center, size = self._linear(rotation)
        damping = np.full(len(rotation), 1e-3)
        state = self._costs(center, rotation, size)
        for done in range(ROUNDS):
            step = self._step(rotation, size, state, damping, held)
            new_center = center + step[:, :3]
            new_size = np.maximum(size + step[:, 3:6], self.config.min_size_m)
            turn = np.pad(step[:, 6:], ((0, 0), (2, 0))) if held else step[:, 6:]
            new_rotation = rotation @ turns(turn)
            new = self._costs(new_center, new_rotation, new_size)
            better = new.cost < state.cost
            gained = bool((state.cost - new.cost > SETTLED * state.cost).any())
            center = np.where(better[:, None], new_center, center)
            size = np.where(better[:, None], new_size, size)
            rotation = np.where(better[:, None, None], new_rotation, rotation)
            damping = np.where(better, damping / 4, damping * 10)
            state = new.where(better, state)
            if not gained and done >= FIRST_ROUNDS:
                break
            if done + 1 == FIRST_ROUNDS and len(rotation) > SURVIVORS:
                kept = np.argsort(state.cost, kind="stable")[:SURVIVORS]
                center, size, rotation, damping = center[kept], size[kept], rotation[kept], damping[kept]
                state = state.at(kept)
        best = int(np.argmin(state.cost))
        return Solution(center[best] + self.shift, rotation[best], size[best], float(state.cost[best]))

    def _linear(self, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Centre and sizes (k, 3) by least squares for fixed rotations."""
        k = len(rotation)
        weight = np.broadcast_to(self.inverse**2, (k, *self.inverse.shape))
        reach = np.abs(self.direction @ rotation) / 2
        solution = np.zeros((k, 6))
        for _ in range(2):
            solution = _solve(self.direction, reach, weight, -self.ends[None], None)
            solution[:, 3:] = np.maximum(solution[:, 3:], self.config.min_size_m)
            middle, out = solution[:, :3] @ self.direction.T, (reach @ solution[:, 3:, None])[:, :, 0]
            residual = np.stack([middle - out, middle + out], axis=2) - self.ends
            weight, _ = self._weights(residual)
        return solution[:, :3], solution[:, 3:]

    def _weights(self, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Huber's weights (k, m, 2) and costs (k,) of residuals."""
        scaled, delta = np.abs(residual) * self.inverse, self.config.huber_sigmas
        inner = np.minimum(scaled, delta)
        weight = delta / np.maximum(scaled, delta) * self.inverse**2
        return weight, (inner * (scaled - 0.5 * inner)).sum(axis=(1, 2))

    def _costs(self, center: np.ndarray, rotation: np.ndarray, size: np.ndarray) -> _State:
        along = self.direction @ rotation
        reach = (np.abs(along) @ size[:, :, None])[:, :, 0] / 2
        middle = center @ self.direction.T
        residual = np.stack([middle - reach, middle + reach], axis=2) - self.ends
        weight, cost = self._weights(residual)
        return _State(along, residual, weight, cost)

    def _step(
        self, rotation: np.ndarray, size: np.ndarray, state: _State, damping: np.ndarray, held: bool
    ) -> np.ndarray:
        """(k, 9 or 7) change of centre, size and rotation (about the box's own axes, or its z axis)."""
        by_reach = _by_size_and_turn(state.along, size, held)
        return _solve(self.direction, by_reach, state.weight, state.residual, damping)


@dataclass(frozen=True)
class _State:
    """What follows from k boxes: directions in box axes, residuals, weights, costs."""

    along: np.ndarray  # (k, m, 3)
    residual: np.ndarray  # (k, m, 2)
    weight: np.ndarray  # (k, m, 2)
    cost: np.ndarray  # (k,)

    def at(self, index: np.ndarray) -> _State:
        return _State(self.along[index], self.residual[index], self.weight[index], self.cost[index])

    def where(self, better: Bool[np.ndarray, "k"], other: _State) -> _State:
        wide = better[:, None, None]
        return _State(
            np.where(wide, self.along, other.along),
            np.where(wide, self.residual, other.residual),
            np.where(wide, self.weight, other.weight),
            np.where(better, self.cost, other.cost),
        )


def _by_size_and_turn(along: np.ndarray, size: np.ndarray, held: bool) -> np.ndarray:
    """(k, m, 6 or 4) derivative of the reach by size and by a turn about the box's own axes (or its z axis).

    `along` (k, m, 3) are the directions in box axes a; a turn by u changes them by a x u, and so the reach by
    u . (g x a) with g_i = s_i / 2 sign(a_i).
    """
    g = np.sign(along) * (size / 2)[:, None, :]
    by_z = g[:, :, 0] * along[:, :, 1] - g[:, :, 1] * along[:, :, 0]
    result = np.empty((*along.shape[:2], 4 if held else 6))
    np.abs(along, out=result[:, :, :3])
    result[:, :, :3] /= 2
    result[:, :, -1] = by_z
    if not held:
        result[:, :, 3] = g[:, :, 1] * along[:, :, 2] - g[:, :, 2] * along[:, :, 1]
        result[:, :, 4] = g[:, :, 2] * along[:, :, 0] - g[:, :, 0] * along[:, :, 2]
    return result


def _solve(
    direction: np.ndarray, by_reach: np.ndarray, weight: np.ndarray, residual: np.ndarray, damping: np.ndarray | None
) -> np.ndarray:
    """(k, 3 + p) weighted least-squares step for residuals (k, m, 2) whose middle changes by `direction` (m, 3) and
    whose reach by `by_reach` (k, m, p); with Levenberg's damping (k,) where given."""
    k, m, p = by_reach.shape
    low, high = weight[:, :, 0], weight[:, :, 1]
    design = np.concatenate([np.broadcast_to(direction, (k, m, 3)), by_reach], axis=2)
    both, odd = (low + high)[:, :, None], (high - low)[:, :, None]
    normal = (design * both).swapaxes(1, 2) @ design
    if odd.any():  # the two ends of an interval weigh differently: middle and reach are not independent
        mixed = np.swapaxes(direction * odd, 1, 2) @ by_reach
        normal[:, :3, 3:], normal[:, 3:, :3] = mixed, mixed.swapaxes(1, 2)
    else:
        normal[:, :3, 3:] = normal[:, 3:, :3] = 0.0
    pull_low, pull_high = low * residual[:, :, 0], high * residual[:, :, 1]
    right = np.empty((k, 3 + p))
    right[:, :3] = (pull_low + pull_high) @ direction
    right[:, 3:] = ((pull_high - pull_low)[:, None, :] @ by_reach)[:, 0]
    diagonal = np.einsum("kii->ki", normal)
    extra = RIDGE * diagonal.sum(axis=1, keepdims=True) / (3 + p)
    if damping is not None:
        extra = extra + damping[:, None] * diagonal
    diagonal += extra
    return np.linalg.solve(normal, -right[:, :, None])[:, :, 0]
