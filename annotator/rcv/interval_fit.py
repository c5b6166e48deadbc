"""One oriented box from many measured intervals: the fit behind the consensus strategy.

A view measures the interval of the object along the directions d of its plane. For a box with centre c, axes r_i and
sizes s_i that interval is `d.c -/+ sum_i s_i / 2 |d.r_i|`. A few directions over-determine the 7 unknowns of an upright
box and the 9 of a free one. The middles of the intervals fix the centre, their lengths the sizes and the rotation. So
rotations are searched on a grid by the lengths alone (`rotations`), and the best ones are refined on all ends by
robust, damped Gauss-Newton steps (`fit_kernels`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from annotator.rcv.rotations import (
    HUBER_SIGMAS,
    MIN_SIZE_M,
    cheapest_distinct,
    free_grid,
    grid_neighbours,
    rotation_costs,
    yaw_grid,
)

# Mean absolute value of a Gaussian variable, in its standard deviations.
MEAN_ABSOLUTE = float(np.sqrt(2 / np.pi))
# Keeps the equations solvable if an unknown is not measured; its variance is then very large.
LEAST_INFORMATION = 1e-9


def expected_iou_loss(
    directions: Float64[np.ndarray, "m 3"],
    weights: Float64[np.ndarray, "m 2"],
    rotation: Float64[np.ndarray, "3 3"],
    size_m: Float64[np.ndarray, "3"],
    held: bool,
    scale: float = 1.0,
) -> float:
    """The expected 1 - IoU of a box with the true one, if its edges' errors are independent.

    The inverse of the weighted normal equations is the covariance of centre, sides and rotation. From it follows by how
    much each face moves, and from that the volume between the two boxes.

    Args:
        directions: unit vectors along which intervals were measured.
        weights: of the low and high end of each; one over the variance, square metres; 0 for an unknown end.
        held: the box turns about its z axis only.

    Returns:
        0 (certain) to 1.
    """
    along = directions @ rotation
    lever = np.sign(along) * size_m / 2
    turns = np.cross(lever, along)
    reach = np.concatenate([np.abs(along) / 2, turns[:, 2:] if held else turns], axis=1)
    # rows of the low and the high end; the centre in box axes
    rows = np.concatenate([np.concatenate([along, -reach], axis=1), np.concatenate([along, reach], axis=1)])
    normal = rows.T @ (rows * weights.T.reshape(-1, 1))
    units = np.sqrt(np.maximum(np.diag(normal), LEAST_INFORMATION))
    products = np.outer(units, units)
    covariance = np.linalg.inv(normal / products + LEAST_INFORMATION * np.eye(len(normal))) / products
    variance = np.diag(covariance)
    center, side, both = variance[:3], variance[3:6], covariance[[0, 1, 2], [3, 4, 5]]
    turn = np.zeros(3)
    turn[2 if held else 0 :] = variance[6:]
    # a turn about one axis tilts the faces across the second by an amount that grows along the third
    squares = size_m**2 / 12
    tilt = np.array([turn[[2, 1]] @ squares[[1, 2]], turn[[2, 0]] @ squares[[0, 2]], turn[[1, 0]] @ squares[[0, 1]]])
    faces = np.sqrt(np.maximum(center + side / 4 + np.array([[1.0], [-1.0]]) * both, 0.0) + tilt)
    between = MEAN_ABSOLUTE * scale * float((faces / size_m).sum())
    # half of the volume between the boxes is inside each of them
    return min(between / (1 + between / 2), 1.0)


# Number of rotations that are refined, and their minimum distance at the start. They are not settings, because they
# only trade accuracy against time.
STARTS = 6
START_DISTANCE_RAD = float(np.deg2rad(10))
# Keeps the equations of the centre solvable if a direction is not measured.
RIDGE = 1e-9

# The views of an object repeat each other's mistakes, so all measured ends together count as this many independent
# ones. Chosen on five sets of boxes.
INDEPENDENT_ENDS = 8
# Standard deviation of a Gaussian variable, in medians of its absolute value.
SIGMAS_PER_MEDIAN = 1.4826

# Smallest singular value of the normalised equations below which a fit is rejected.
MIN_DETERMINACY = 0.02


@dataclass(frozen=True)
class Intervals:
    """m measured intervals.

    Attributes:
        directions: (m, 3) unit vectors, camera frame.
        ends_m: (m, 2) low and high end along the direction, metres.
        sigma_m: (m, 2) expected error of each end, metres; infinite for an unknown end.
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
        ends: the ends that it was fitted to.
        held: whether its z axis was held.
    """

    center_m: Float64[np.ndarray, "3"]
    rotation: Float64[np.ndarray, "3 3"]
    size_m: Float64[np.ndarray, "3"]
    cost: float
    residual_m: float
    ends: Edges
    held: bool

    def expected_iou_loss(self) -> float:
        """The expected 1 - IoU with the true box, by the errors that the fit itself has."""
        ends = self.ends
        known = ends.inverse > 0
        errors = np.abs(ends.residuals(self.center_m, self.rotation, self.size_m)) * ends.inverse
        weights = ends.inverse**2 * np.minimum(1.0, HUBER_SIGMAS / np.maximum(errors, 1e-9))
        scale = SIGMAS_PER_MEDIAN * float(np.median(errors[known])) * float(np.sqrt(known.sum() / INDEPENDENT_ENDS))
        return expected_iou_loss(ends.direction, weights, self.rotation, self.size_m, self.held, scale)


def fit_box(
    intervals: Intervals,
    up: Float64[np.ndarray, "3"] | None,
    near: Float64[np.ndarray, "3 3"] | None = None,
) -> BoxFit | None:
    """The box that fits the intervals best; None if they do not determine one.

    Args:
        up: unit vector along which the box's z axis is held; None leaves the rotation free.
        near: (3, 3) box rotation to try besides the grid, such as that of the last step.
    """
    from annotator.rcv.fit_kernels import FREE, HELD, determined, refine

    known = np.isfinite(intervals.sigma_m)
    if known.sum() < (7 if up is not None else 9):
        return None
    edges = Edges.of(intervals)
    unknowns = HELD if up is not None else FREE
    starts = np.array(_starts(intervals, up, near), order="C")
    (center, rotation, size), cost = refine(edges.measured, starts, unknowns, HUBER_SIGMAS, MIN_SIZE_M)
    if not np.isfinite(cost) or (size <= MIN_SIZE_M).any():
        return None
    center_m = center + edges.shift
    if not determined(edges.measured, (center_m, rotation, size), unknowns, MIN_DETERMINACY):
        return None
    spread = SIGMAS_PER_MEDIAN * float(np.median(np.abs(edges.residuals(center_m, rotation, size)[known])))
    return BoxFit(center_m, rotation, size, cost, spread, edges, up is not None)


def _starts(intervals: Intervals, up: np.ndarray | None, near: np.ndarray | None) -> Float64[np.ndarray, "k 3 3"]:
    """The grid's rotations that fit the intervals' lengths best, and `near`."""
    grid = free_grid() if up is None else yaw_grid(up)
    costs = rotation_costs(intervals.directions, intervals.ends_m, intervals.sigma_m, grid)
    count = STARTS if near is None else STARTS - 1
    best = cheapest_distinct(costs, grid_neighbours(up, START_DISTANCE_RAD), count)
    return grid[best] if near is None else np.concatenate([near[None], grid[best]])


@dataclass(frozen=True)
class Edges:
    """The ends of m intervals, centred for precision.

    Attributes:
        direction: (m, 3) unit vectors.
        ends: (m, 2) low and high end, metres from `shift`; 0 if unknown.
        inverse: (m, 2) one over the expected error; 0 if unknown.
        shift: (3,) what was subtracted from all positions, metres.
    """

    direction: Float64[np.ndarray, "m 3"]
    ends: Float64[np.ndarray, "m 2"]
    inverse: Float64[np.ndarray, "m 2"]
    shift: Float64[np.ndarray, "3"]

    @classmethod
    def of(cls, intervals: Intervals) -> Edges:
        direction, ends_m, sigma_m = intervals.directions, intervals.ends_m, intervals.sigma_m
        known = np.isfinite(sigma_m)
        middle = np.where(known, ends_m, 0.0) @ (0.5, 0.5)
        # any point near the object is sufficient; the ridge handles directions without an interval
        spread = direction.T @ direction + RIDGE * len(direction) * np.eye(3)
        shift = np.linalg.solve(spread, direction.T @ middle)
        ends = np.where(known, ends_m - (direction @ shift)[:, None], 0.0)
        return cls(np.array(direction, order="C"), ends, 1 / sigma_m, shift)

    def residuals(self, center_m: np.ndarray, rotation: np.ndarray, size_m: np.ndarray) -> Float64[np.ndarray, "m 2"]:
        """The ends that a box has, minus the measured ones, metres."""
        reach = np.abs(self.direction @ rotation) @ size_m / 2
        middle = self.direction @ (center_m - self.shift)
        return np.stack([middle - reach, middle + reach], axis=1) - self.ends

    @property
    def measured(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.direction, self.ends, self.inverse
