"""One oriented box from many measured intervals: the fit behind the consensus strategy.

A view along a known direction measures, for each direction d in its plane, the interval of the object on d. For a box
with centre c, axes r_i and sizes s_i that interval is `d.c -/+ sum_i s_i / 2 |d.r_i|` (DESIGN: a few directions
over-determine the 5 unknowns of an upright and the 9 of a free box). The middles of the intervals hold the centre and
their lengths size and rotation: so orientations are searched on a grid by the lengths alone, with three unknowns each
(`reach_costs`), and the best ones refined by robust Gauss-Newton steps on everything (`interval_refine`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from annotator.rcv.config import FitConfig
from annotator.rcv.interval_refine import Edges
from annotator.rcv.reach_costs import reach_costs
from annotator.rcv.rotation_grid import distinct, free_grid, grid_near, yaw_grid

# How many rotations are refined, and how far apart they are: steps of a computation, which decide nothing about an
# object.
STARTS = 6
START_DISTANCE_RAD = float(np.deg2rad(10))

DEFAULTS = FitConfig()


@dataclass(frozen=True)
class Intervals:
    """m measured intervals.

    Attributes:
        directions: (m, 3) unit vectors, camera frame.
        ends_m: (m, 2) low and high end along the direction, metres.
        sigma_m: (m, 2) expected error of each end, metres; infinite where an end is not known.
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
    near: Float64[np.ndarray, "3 3"] | None = None,
    config: FitConfig = DEFAULTS,
) -> BoxFit | None:
    """The box that explains the intervals best; None where they do not fix one.

    Args:
        up: holds the box's z axis at this unit vector; None leaves the rotation free.
        near: (3, 3) box rotation to try besides the grid, such as the last step's.
    """
    known = np.isfinite(intervals.sigma_m)
    if known.sum() < (7 if up is not None else 9):
        return None
    edges = Edges.of(intervals.directions, intervals.ends_m, intervals.sigma_m, config)
    fit = edges.refine(_starts(intervals, up, near, config), held=up is not None)
    if not np.isfinite(fit.cost) or (fit.size_m <= config.min_size_m).any():
        return None
    if not edges.fixes(fit, held=up is not None):
        return None
    off = np.sort(np.abs(edges.residuals(fit)[known]))
    # the median; numpy's own takes several times as long for so few
    spread = 1.4826 * float(off[(len(off) - 1) // 2] + off[len(off) // 2]) / 2
    return BoxFit(fit.center_m, fit.rotation, fit.size_m, fit.cost, spread)


def _starts(
    intervals: Intervals, up: np.ndarray | None, near: np.ndarray | None, config: FitConfig
) -> Float64[np.ndarray, "k 3 3"]:
    """The rotations of the grid that explain the intervals' lengths best, and `near`."""
    grid = free_grid() if up is None else yaw_grid(up)
    costs = reach_costs(intervals.directions, intervals.ends_m, intervals.sigma_m, grid, config)
    best = distinct(costs, grid_near(up, START_DISTANCE_RAD), STARTS if near is None else STARTS - 1)
    return grid[best] if near is None else np.concatenate([near[None], grid[best]])
