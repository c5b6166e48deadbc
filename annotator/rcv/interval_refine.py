"""The refinement of a box through measured intervals: damped Gauss-Newton from several rotations.

The steps themselves are compiled loops (`kernels.refinement`); here the ends of intervals are made ready for them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from annotator.rcv.config import FitConfig

# Keeps the equations of a centre solvable while a direction is not measured at all.
RIDGE = 1e-9


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
        middle = np.where(known, ends_m, 0.0) @ (0.5, 0.5)
        # any place nearby will do: the small term is for what no direction measures
        spread = direction.T @ direction + RIDGE * len(direction) * np.eye(3)
        shift = np.linalg.solve(spread, direction.T @ middle)
        ends = np.where(known, ends_m - (direction @ shift)[:, None], 0.0)
        return cls(np.array(direction, order="C"), ends, 1 / sigma_m, shift, config)

    def residuals(self, fit: Solution) -> Float64[np.ndarray, "m 2"]:
        """Predicted minus measured ends, metres."""
        reach = np.abs(self.direction @ fit.rotation) @ fit.size_m / 2
        middle = self.direction @ (fit.center_m - self.shift)
        return np.stack([middle - reach, middle + reach], axis=1) - self.ends

    def fixes(self, fit: Solution, held: bool) -> bool:
        """Whether the equations hold all unknowns of a box, and not only some of them; see `refine` for `held`."""
        from annotator.rcv.kernels.refinement import FREE, HELD, determined

        box = (fit.center_m, fit.rotation, fit.size_m)
        return determined(self._measured, box, HELD if held else FREE, self.config.min_determinacy)

    def refine(self, rotation: Float64[np.ndarray, "k 3 3"], held: bool) -> Solution:
        """The best box that steps from any of several rotations lead to.

        Args:
            rotation: where to start; columns = box axes.
            held: turn about the boxes' z axes only.
        """
        from annotator.rcv.kernels.refinement import FREE, HELD, refine

        starts, unknowns = np.array(rotation, order="C"), HELD if held else FREE
        delta, least = self.config.huber_sigmas, self.config.min_size_m
        (center, turned, size), cost = refine(self._measured, starts, unknowns, delta, least)
        return Solution(center + self.shift, turned, size, cost)

    @property
    def _measured(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.direction, self.ends, self.inverse
