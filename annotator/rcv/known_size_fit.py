"""The pose of a box of known size from measured intervals.

An object that is followed keeps its reviewed size, so its views only have to tell where it is and how it is turned.
This helps most where a side is hidden: the visible faces then place the whole box.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation

from annotator.rcv.config import FitConfig, RcvConfig
from annotator.rcv.cross_view import measured_intervals
from annotator.rcv.interval_fit import Intervals
from annotator.types import OrientedBox, PseudoView, StepTrace

# Largest rotation away from the start, and the numbers of rotations that are tried: about the vertical, and freely.
REACH_RAD = 0.7
UPRIGHT_TRIES, FREE_TRIES = 29, 400
# Each round tries rotations around the best one so far, in a range smaller by this factor.
ROUNDS, SHRINK = 3, 0.3
# Rounds of the robust weights.
REWEIGHTINGS = 4
RIDGE = 1e-6


def fit_known_size(
    intervals: Intervals,
    start: OrientedBox,
    up: Float64[np.ndarray, "3"] | None,
    config: FitConfig,
) -> OrientedBox:
    """The box of the size of `start` that fits the intervals best, with a rotation near that of `start`.

    Args:
        intervals: at least three directions that span space.
        start: its axes and sides belong together.
        up: unit vector about which an upright box turns; None for a free one.
    """
    rotation, center, reach = start.rotation, start.center_m, REACH_RAD
    for _ in range(ROUNDS):
        tried = _turned(rotation, up, reach)
        centers, costs = _placed(intervals, tried, start.size_m, center, config)
        best = int(np.argmin(costs))
        rotation, center, reach = tried[best], centers[best], reach * SHRINK
    return OrientedBox.from_parts(center, rotation, start.size_m)


def traced_intervals(trace: Sequence[StepTrace], config: RcvConfig) -> Intervals | None:
    """The intervals that the used detections of a trace measured; None without any."""
    views, boxes = [], []
    for step in trace:
        for view in step.views:
            if view.used is not None:
                blank = np.zeros((view.height_px, view.width_px, 3), np.uint8)
                none = np.zeros((0, 3), np.float32)
                views.append(PseudoView(blank, np.array(view.axes), view.metres_per_px, np.array(view.origin_m), none))
                boxes.append(view.boxes[view.used])
    return measured_intervals(views, boxes, config) if views else None


def _turned(
    rotation: Float64[np.ndarray, "3 3"], up: np.ndarray | None, reach_rad: float
) -> Float64[np.ndarray, "k 3 3"]:
    vectors = reach_rad * (_ball() if up is None else np.linspace(-1, 1, UPRIGHT_TRIES)[:, None] * up)
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix() @ rotation)


@lru_cache(maxsize=1)
def _ball() -> Float64[np.ndarray, "k 3"]:
    """Points spread over the unit ball, the centre first."""
    rng = np.random.default_rng(0)
    points = rng.standard_normal((FREE_TRIES, 3))
    points *= (rng.random(FREE_TRIES) ** (1 / 3) / np.linalg.norm(points, axis=1))[:, None]
    points[0] = 0.0
    return points


def _placed(
    intervals: Intervals,
    rotations: Float64[np.ndarray, "k 3 3"],
    size_m: Float[np.ndarray, "3"],
    center: Float64[np.ndarray, "3"],
    config: FitConfig,
) -> tuple[Float64[np.ndarray, "k 3"], Float64[np.ndarray, "k"]]:
    """The best centre for each rotation by robust least squares (Huber), and its cost."""
    directions = intervals.directions
    reach = 0.5 * np.abs(directions @ rotations) @ size_m
    known = np.isfinite(intervals.sigma_m)
    ends = np.where(known, intervals.ends_m - (directions @ center)[:, None], 0.0)
    inverse = np.where(known, 1 / intervals.sigma_m, 0.0)
    # the middle of the box that each end measures: (k, m, 2)
    middles = ends + np.stack([reach, -reach], axis=-1)
    weights = np.broadcast_to(inverse**2, middles.shape)
    shift = np.zeros((len(rotations), 3))
    for _ in range(REWEIGHTINGS):
        total = weights.sum(axis=-1)
        normal = np.einsum("km,mi,mj->kij", total, directions, directions)
        normal += RIDGE * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        right = np.einsum("km,mi->ki", (weights * middles).sum(axis=-1), directions)
        shift = np.linalg.solve(normal, right[..., None])[..., 0]
        errors = np.abs((shift @ directions.T)[..., None] - middles) * inverse
        weights = inverse**2 * np.minimum(1.0, config.huber_sigmas / np.maximum(errors, 1e-9))
    delta = config.huber_sigmas
    costs = np.where(errors <= delta, 0.5 * errors**2, delta * (errors - 0.5 * delta)).sum(axis=(1, 2))
    return center + shift, costs
