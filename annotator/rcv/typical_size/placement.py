"""Places of a box of a typical size: candidates around the points in the frustum of an image box.

An object of typical size needs no first look of a detector: how large it appears tells its distance, and the points
tell where its surface is. Rotations come from a grid, sizes from samples around the typical one, depths from points.
The best candidates are then moved, turned and resized at random, in two rounds.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float64

from annotator.geometry.iou import iou_3d
from annotator.rcv.rotation_search import free_grid, rotation_matrices, yaw_grid
from annotator.rcv.typical_size.evidence import Candidates, Evidence
from annotator.types import OrientedBox

# Percentiles of the depths in the middle of the image box at which the object's surface may be.
DEPTHS_UPRIGHT, DEPTHS_FREE = np.linspace(2, 98, 14), np.linspace(2, 98, 10)
# How far behind the surface the centre may be, shares of the box's half extent along the ray.
BEHIND_UPRIGHT, BEHIND_FREE = (0.4, 0.9), (0.65,)
# Number of sizes that are tried: the typical one, and samples.
SIZES_UPRIGHT, SIZES_FREE = 6, 2
# Number of candidates whose outline agrees best with the image box, and of those with the best score.
BY_OUTLINE, BY_SCORE = 500, 100
# In each round, this many candidates are changed this many times.
ROUNDS, CHANGED, TIMES = 2, 16, 12
# Number of changes of a measured box before the rounds, and of the best boxes near it that are kept: they are much
# alike, and comparing them takes longer than finding them.
NEAR, NEAR_KEPT = 20, 20
# Standard deviations of the changes in the first round, halved in later ones: shift in sides, rotation in radians, and
# sides in spreads of the typical size.
SHIFT, TURN_RAD, RESIZE = 0.1, 0.2, 0.6


def place(evidence: Evidence) -> Candidates:
    """The most plausible boxes, best first."""
    boxes = _grid(evidence)
    boxes = boxes.take(np.argsort(evidence.edge_errors(boxes), kind="stable")[:BY_OUTLINE])
    return _improved(boxes, evidence, np.random.default_rng(0))


def place_near(evidence: Evidence, box: OrientedBox) -> Candidates:
    """The most plausible boxes near a measured one, best first."""
    random = np.random.default_rng(0)
    measured = Candidates.of([box])
    boxes = Candidates.concatenate([measured, changed(measured, evidence, NEAR, 1.0, random)])
    return _improved(boxes, evidence, random).take(np.arange(NEAR_KEPT))


def _improved(boxes: Candidates, evidence: Evidence, random: np.random.Generator) -> Candidates:
    """The best boxes after the rounds of changes, best first."""
    score = evidence.score(boxes)
    for number in range(ROUNDS):
        best = np.argsort(-score, kind="stable")[:CHANGED]
        new = changed(boxes.take(best), evidence, TIMES, 0.5**number, random)
        boxes, score = Candidates.concatenate([boxes, new]), np.concatenate([score, evidence.score(new)])
    return boxes.take(np.argsort(-score, kind="stable")[:BY_SCORE])


def distinct(boxes: Candidates, count: int, max_iou: float) -> list[OrientedBox]:
    """Up to `count` of the first candidates, without those that overlap with an earlier one by more than `max_iou`."""
    chosen: list[OrientedBox] = []
    for index in range(len(boxes)):
        (box,) = boxes.take(np.array([index])).boxes
        if all(iou_3d(box, other) <= max_iou for other in chosen):
            chosen.append(box)
            if len(chosen) == count:
                break
    return chosen


def changed(boxes: Candidates, evidence: Evidence, times: int, scale: float, random: np.random.Generator) -> Candidates:
    """Each box moved, turned and resized at random, several times.

    Args:
        scale: size of the changes; 1 in the first round of `place`.
    """
    boxes = boxes.take(np.repeat(np.arange(len(boxes)), times))
    count, turn, up = len(boxes), TURN_RAD * scale, evidence.up
    vectors = random.normal(0, turn, (count, 3)) if up is None else random.normal(0, turn, (count, 1)) * up
    shift = random.normal(0, SHIFT * scale, (count, 3)) * boxes.size_m
    spread = RESIZE * scale * float(np.mean(evidence.typical.spread))
    return Candidates(
        rotation_matrices(vectors) @ boxes.rotation,
        boxes.center_m + np.einsum("kij,kj->ki", boxes.rotation, shift),
        boxes.size_m * np.exp(random.normal(0, spread, (count, 3))),
    )


def _grid(evidence: Evidence) -> Candidates:
    """All combinations of rotation, size and depth, with their outlines centred on the image box."""
    is_free = evidence.up is None
    rotations = free_grid() if evidence.up is None else yaw_grid(evidence.up)
    samples = _samples(evidence, SIZES_FREE if is_free else SIZES_UPRIGHT)
    sizes = np.concatenate([samples[:, list(order)] for order in evidence.size_orders])
    percentiles = DEPTHS_FREE if is_free else DEPTHS_UPRIGHT
    depths = np.unique(np.percentile(evidence.points[evidence.middle, 2], percentiles))
    behind = np.array(BEHIND_FREE if is_free else BEHIND_UPRIGHT)
    left, right, top, bottom = evidence.window
    ray = np.array([(left + right) / 2, (top + bottom) / 2, 1.0])
    length = float(np.linalg.norm(ray))
    half = np.abs(np.einsum("rij,i->rj", rotations, ray / length)) @ sizes.T / 2
    distance = depths[:, None, None, None] * length + behind[:, None, None] * half
    shape = (*distance.shape, 3)
    rotation = np.broadcast_to(rotations[:, None], (*shape, 3)).reshape(-1, 3, 3)
    size = np.ascontiguousarray(np.broadcast_to(sizes, shape)).reshape(-1, 3)
    return _centred(evidence, Candidates(rotation, distance.reshape(-1, 1) * ray / length, size))


def _samples(evidence: Evidence, count: int) -> Float64[np.ndarray, "k 3"]:
    """The typical sides, and evenly spread samples around them, metres."""
    offsets = np.concatenate([np.zeros((1, 3)), _spread_normals()[: count - 1] * np.array(evidence.typical.spread)])
    return np.asarray(np.array(evidence.typical.size_m) * np.exp(offsets))


@lru_cache(maxsize=1)
def _spread_normals() -> Float64[np.ndarray, "8 3"]:
    """Evenly spread samples of a standard normal distribution."""
    from scipy.stats import qmc  # takes a third of a second, and most commands place nothing

    return np.asarray(qmc.MultivariateNormalQMC(np.zeros(3), rng=0).random(8))


def _centred(evidence: Evidence, boxes: Candidates) -> Candidates:
    """The boxes shifted at constant depth so that their outlines are centred on the image box."""
    left, right, top, bottom = evidence.window
    center = boxes.center_m
    for _ in range(2):
        ends = evidence.outlines(Candidates(boxes.rotation, center, boxes.size_m))
        shift = np.column_stack([left + right - ends[:, 0] - ends[:, 1], top + bottom - ends[:, 2] - ends[:, 3]]) / 2
        center = center + np.column_stack([shift, np.zeros(len(shift))]) * center[:, 2:]
    return Candidates(boxes.rotation, center, boxes.size_m)
