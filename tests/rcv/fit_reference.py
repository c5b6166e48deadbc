"""Reference implementation of the box fit in plain linear algebra, one rotation at a time, for tests of the kernels."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from annotator.rcv.config import FitConfig
from annotator.rcv.interval_fit import Intervals


def huber(scaled: np.ndarray, delta: float) -> tuple[np.ndarray, float]:
    size = np.abs(scaled)
    cost = np.where(size <= delta, size**2 / 2, delta * (size - delta / 2)).sum()
    return np.where(size <= delta, 1.0, delta / np.maximum(size, 1e-300)), float(cost)


def size_cost(intervals: Intervals, rotation: np.ndarray, config: FitConfig, rounds: int) -> float:
    """The robust cost of the intervals' lengths with the best sizes for a rotation."""
    sigma = np.hypot(*intervals.sigma_m.T) / 2
    known = np.isfinite(sigma)
    design = np.abs(intervals.directions[known] @ rotation) / 2 / sigma[known, None]
    target = np.diff(intervals.ends_m[known], axis=1)[:, 0] / 2 / sigma[known]
    weight, cost = np.ones(len(target)), np.inf
    for _ in range(rounds):
        normal = design.T @ (weight[:, None] * design)
        sizes = np.linalg.solve(normal + 1e-6 * np.trace(normal) * np.eye(3), design.T @ (weight * target))
        weight, cost = huber(design @ np.maximum(sizes, config.min_size_m) - target, config.huber_sigmas)
    return cost


def refined(
    intervals: Intervals, rotations: np.ndarray, held: bool, config: FitConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Centre, rotation, sizes and cost of the best box; with the steps, rounds and damping of `Edges.refine`."""
    boxes = [_placed(intervals, rotation, config) for rotation in rotations]
    costs = [_equations(intervals, box, 6, config)[3] for box in boxes]
    damping, active = [1e-3] * len(boxes), list(range(len(boxes)))
    for done in range(12):
        gained = False
        for k in active:
            new = _stepped(intervals, boxes[k], 7 if held else 9, damping[k], config)
            cost = _equations(intervals, new, 6, config)[3]
            gained |= costs[k] - cost > 1e-5 * costs[k]
            if cost < costs[k]:
                boxes[k], costs[k], damping[k] = new, cost, damping[k] / 4
            else:
                damping[k] *= 10
        if not gained and done >= 4:
            break
        if done == 3:
            active = sorted(active, key=lambda k: costs[k])[:2]
    best = min(active, key=lambda k: costs[k])
    return (*boxes[best], costs[best])


def smallest_singular_value(intervals: Intervals, rotation: np.ndarray, size: np.ndarray, held: bool) -> float:
    """The smallest singular value of a box's normalised Jacobian; 0 if the equations do not contain an unknown."""
    box = (np.zeros(3), rotation, size)
    jacobian = _equations(intervals, box, 7 if held else 9, FitConfig())[0]
    scale = np.linalg.norm(jacobian, axis=0)
    return 0.0 if (scale == 0).any() else float(np.linalg.svd(jacobian / scale, compute_uv=False)[-1])


def _equations(intervals: Intervals, box, unknowns: int, config: FitConfig):
    """Jacobian and residuals in units of the expected error, low ends before high ends; Huber weights and cost."""
    center, rotation, size = box
    d = intervals.directions
    along = d @ rotation
    turn = np.cross(size / 2 * np.sign(along), along)
    by_reach = np.column_stack([np.abs(along) / 2, {6: turn[:, :0], 7: turn[:, 2:], 9: turn}[unknowns]])
    reach = np.abs(along) @ size / 2
    known = np.isfinite(intervals.sigma_m)
    ends = np.where(known, intervals.ends_m, 0.0)
    inverse = np.where(known, 1 / intervals.sigma_m, 0.0).T.reshape(-1)
    jacobian = np.concatenate([np.column_stack([d, -by_reach]), np.column_stack([d, by_reach])])
    residual = np.concatenate([d @ center - reach - ends[:, 0], d @ center + reach - ends[:, 1]])
    weight, cost = huber(residual * inverse, config.huber_sigmas)
    return jacobian * inverse[:, None], residual * inverse, weight, cost


def _solved(jacobian: np.ndarray, residual: np.ndarray, weight: np.ndarray, damping: float) -> np.ndarray:
    normal = jacobian.T @ (weight[:, None] * jacobian)
    ridge = 1e-6 * np.trace(normal) / len(normal)
    extra = ridge * np.eye(len(normal)) + damping * np.diag(np.diag(normal))
    return -np.linalg.solve(normal + extra, jacobian.T @ (weight * residual))


def _placed(intervals: Intervals, rotation: np.ndarray, config: FitConfig):
    box = (np.zeros(3), rotation, np.zeros(3))
    for robust in (False, True):
        jacobian, residual, weight, _ = _equations(intervals, box, 6, config)
        step = _solved(jacobian, residual, weight if robust else np.ones(len(weight)), 0.0)
        box = (box[0] + step[:3], rotation, np.maximum(box[2] + step[3:], config.min_size_m))
    return box


def _stepped(intervals: Intervals, box, unknowns: int, damping: float, config: FitConfig):
    jacobian, residual, weight, _ = _equations(intervals, box, unknowns, config)
    step = _solved(jacobian, residual, weight, damping)
    turn = step[6:] if unknowns == 9 else [0.0, 0.0, step[6]]
    size = np.maximum(box[2] + step[3:6], config.min_size_m)
    return box[0] + step[:3], box[1] @ Rotation.from_rotvec(turn).as_matrix(), size
