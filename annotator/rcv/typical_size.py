"""Objects of a class with a typical size: where a box of about this size may be, and which is best.

**Places.** An object of typical size needs no first look of a detector: how large it appears tells its distance, and
the points tell where its surface is. Rotations come from a grid, sizes from samples around the typical one, depths from
points. The best candidates are then moved, turned and resized at random, in two rounds.

**Evidence.** The points of a frustum, the image box, the typical size and the views give each candidate a score, a
weighted sum of six terms (`Evidence.score`). The result is not the candidate with the highest score, but the one with
the highest expected IoU (`best_expected`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import permutations

import numpy as np
from jaxtyping import Bool, Float, Float64

from annotator.geometry.iou import iou_3d, iou_3d_matrix
from annotator.rcv.config import TypicalSize
from annotator.rcv.first_look import Outline, edges_normalised, in_middle
from annotator.rcv.interval_fit import Intervals
from annotator.rcv.rotations import free_grid, rotation_matrices, yaw_grid
from annotator.types import Box2D, Camera, OrientedBox

# Number of points of a frustum that are used.
POINTS = 300
# Margin around a box within which points count as inside, share of its mean side.
MARGIN = 0.03
# Expected error of an outline's edge besides that of the image box, share of its width or height: the outline of a
# 3D box is often larger than a box around the object, because its corners are empty, but seldom smaller.
LARGER_SHARE, SMALLER_SHARE = 0.1, 0.05
# The direction in which each edge of an outline leaves the object: left, right, top, bottom.
OUTWARD = np.array([-1.0, 1.0, -1.0, 1.0])
# Limit of an edge's error, a side's deviation and a measured end's error, standard deviations.
FURTHEST = 4.0
# Weights of the score; the geometric ones in the order of the terms. Chosen on generated frames and on several
# recordings.
WEIGHTS = np.array([0.5, 0.6, 0.6, -0.2, -0.12])
MEASURED_WEIGHT = -0.33
# How many of the best candidates may be right, and how much more probable one is for a score that is higher by 1 (log).
PROBABLE, SHARPNESS = 30, 12.0


@dataclass(frozen=True, eq=False)
class Candidates:
    """k boxes.

    Attributes:
        rotation: columns = box axes in the camera frame.
        center_m, size_m: metres.
    """

    rotation: Float64[np.ndarray, "k 3 3"]
    center_m: Float64[np.ndarray, "k 3"]
    size_m: Float64[np.ndarray, "k 3"]

    def __len__(self) -> int:
        return len(self.center_m)

    def take(self, index: np.ndarray) -> Candidates:
        """The candidates at these indices."""
        return Candidates(self.rotation[index], self.center_m[index], self.size_m[index])

    @property
    def boxes(self) -> list[OrientedBox]:
        """The candidates as boxes."""
        parts = zip(self.center_m, self.rotation, self.size_m, strict=True)
        return [OrientedBox.from_parts(*each) for each in parts]

    @classmethod
    def of(cls, boxes: Sequence[OrientedBox]) -> Candidates:
        """From boxes; at least one."""
        rotation = np.stack([box.rotation for box in boxes])
        return cls(rotation, np.stack([b.center_m for b in boxes]), np.stack([b.size_m for b in boxes]))

    @classmethod
    def concatenate(cls, parts: Sequence[Candidates]) -> Candidates:
        """All candidates of all parts."""
        rotation = np.concatenate([p.rotation for p in parts])
        return cls(rotation, np.concatenate([p.center_m for p in parts]), np.concatenate([p.size_m for p in parts]))


@dataclass(frozen=True, eq=False)
class Evidence:
    """What is known of an object without a detector on views.

    Attributes:
        points: a sample of the points in its frustum, camera frame.
        middle: which of them project into the middle of the image box.
        window: left, right, top and bottom end of the expected outline, normalised (x/z, y/z).
        sigma: expected errors of these ends, normalised.
        image: the ends of the image, in the same way.
        up: unit vector against gravity for an upright box, None for a free one.
    """

    points: Float64[np.ndarray, "n 3"]
    middle: Bool[np.ndarray, "n"]
    window: Float64[np.ndarray, "4"]
    image: Float64[np.ndarray, "4"]
    sigma: Float64[np.ndarray, "4"]
    typical: TypicalSize
    up: Float64[np.ndarray, "3"] | None

    @classmethod
    def of(
        cls,
        camera: Camera,
        xyz_m: Float[np.ndarray, "n 3"],
        image_box: Box2D,
        outline: Outline,
        typical: TypicalSize,
        up: Float64[np.ndarray, "3"] | None,
    ) -> Evidence | None:
        """From the points in the frustum of an image box; other arguments as the attributes.

        None if the camera's distortion has no inverse at the edges of the outline.
        """
        chosen = np.random.default_rng(0).permutation(len(xyz_m))[:POINTS]
        points = xyz_m[chosen].astype(np.float64)
        ends = (-0.5, camera.width_px - 0.5, -0.5, camera.height_px - 0.5)
        edges = (outline.box.x_min, outline.box.x_max, outline.box.y_min, outline.box.y_max)
        window, image = edges_normalised(camera, edges), edges_normalised(camera, ends)
        if not np.isfinite(window).all():
            return None
        # where the distortion has no inverse at the image's border, outlines are not clipped
        image = np.where(np.isfinite(image), image, [-np.inf, np.inf, -np.inf, np.inf])
        sigma = outline.sigma_px / np.array([camera.fx, camera.fx, camera.fy, camera.fy])
        return cls(points, in_middle(camera, points, image_box), window, image, sigma, typical, up)

    @property
    def size_orders(self) -> list[tuple[int, ...]]:
        """The orders in which typical sides may lie along a box's axes; an upright box's last side is its height."""
        return list(permutations(range(3))) if self.up is None else [(0, 1, 2), (1, 0, 2)]

    def outlines(self, boxes: Candidates) -> Float64[np.ndarray, "k 4"]:
        """The outlines of boxes, clipped to the image: left, right, top, bottom, normalised."""
        from annotator.rcv.fit_kernels import outlines

        return outlines(boxes.rotation, boxes.center_m, boxes.size_m, self.image)

    def edge_errors(self, boxes: Candidates) -> Float64[np.ndarray, "k"]:
        """The mean distance of the outlines' edges from the image box's, standard deviations, each limited."""
        left, right, top, bottom = self.window
        sides = np.array([right - left, right - left, bottom - top, bottom - top])
        beyond = (self.outlines(boxes) - self.window) * OUTWARD
        share = np.where(beyond > 0, LARGER_SHARE, SMALLER_SHARE)
        errors = np.abs(beyond) / np.hypot(self.sigma, share * sides)
        return np.asarray(np.minimum(errors, FURTHEST).mean(axis=1))

    def score(self, boxes: Candidates, measured: Sequence[Intervals] = ()) -> Float64[np.ndarray, "k"]:
        """The score of each box.

        The terms: hits (points of the frustum inside the box) as a share of all points, of those that are not in front
        of the box, and the same in the middle of the image box; the errors of the outline's edges; the deviation of
        the sides from the typical ones; and the distance of the box's ends from those that views have measured, in
        their expected errors, so that an accurate detector counts more.

        Args:
            measured: what the views of each rival measured; the one with the least distance counts.
        """
        from annotator.rcv.fit_kernels import point_evidence

        hits = point_evidence(boxes.rotation, boxes.center_m, boxes.size_m, self.points, self.middle, MARGIN)
        terms = np.column_stack([hits, self.edge_errors(boxes), self._deviation(boxes.size_m)])
        score = terms @ WEIGHTS
        if measured:
            score += MEASURED_WEIGHT * np.min([_distance(boxes, intervals) for intervals in measured], axis=0)
        return score

    def _deviation(self, size_m: Float64[np.ndarray, "k 3"]) -> Float64[np.ndarray, "k"]:
        """The mean deviation of each box's sides from the typical ones, standard deviations, each limited."""
        sides, spread = np.log(self.typical.size_m), np.array(self.typical.spread)
        away = [np.abs(np.log(size_m) - sides[list(o)]) / spread[list(o)] for o in self.size_orders]
        return np.asarray(np.minimum(away, FURTHEST).mean(axis=2).min(axis=0))


def best_expected(boxes: Candidates, score: Float64[np.ndarray, "k"]) -> tuple[OrientedBox, float]:
    """The candidate with the highest expected IoU with the true box, and this IoU.

    One of the best candidates is taken to be the true box, with a probability that grows exponentially with its score.
    """
    best = np.argsort(-score, kind="stable")[:PROBABLE]
    probable = boxes.take(best).boxes
    weight = np.exp(SHARPNESS * (score[best] - score[best[0]]))
    expected = iou_3d_matrix(probable, probable) @ weight / weight.sum()
    chosen = int(np.argmax(expected))
    return probable[chosen], float(min(expected[chosen], 1.0))


def _distance(boxes: Candidates, measured: Intervals) -> Float64[np.ndarray, "k"]:
    """The mean distance of each box's ends from the measured ones, in their expected errors, each limited."""
    directions, known = measured.directions, np.isfinite(measured.sigma_m)
    reach = np.einsum("kmi,ki->km", np.abs(directions @ boxes.rotation), boxes.size_m) / 2
    middle = boxes.center_m @ directions.T
    away = np.abs(np.stack([middle - reach, middle + reach], axis=2) - measured.ends_m)[:, known]
    return np.asarray(np.minimum(away / measured.sigma_m[known], FURTHEST).mean(axis=1))


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
