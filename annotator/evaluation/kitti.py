"""KITTI's object benchmark: average precision on the image, in bird's-eye view and in 3D, and orientation similarity.

It follows the devkit's program (devkit_object, `cpp/evaluate_object.cpp`) exactly, including the order in which boxes
are matched, and gives the same numbers.

The greedy assignment of detections to true boxes is done for all frames and all score thresholds at once. Frames are
independent, and a threshold only removes detections, so the order in which a true box prefers the others is the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float64, Int, Int64, Shaped

from annotator.evaluation.boxes import BoxPairs, Table, blocks_within, overlapping
from annotator.geometry.outline import rectangle_intersection_pairs


def assign(
    truth: Int[np.ndarray, "p"],
    detection: Int[np.ndarray, "p"],
    frames: Int[np.ndarray, "g"],
    detections: int,
    preference: Sequence[Shaped[np.ndarray, "p"]],
    usable: Bool[np.ndarray, "p t"],
) -> tuple[Bool[np.ndarray, "p t"], Bool[np.ndarray, "g t"], Bool[np.ndarray, "d t"]]:
    """Assigns detections to true rows, for each threshold (column).

    Args:
        truth, detection: row indices of the pairs that overlap enough, from 0. The true rows of a frame are processed
            in the order of their indices.
        frames: frame of each true row.
        detections: number of detections.
        preference: sort keys of each true row's candidates, smallest first; the first array is the primary key.
        usable: whether the pair's detection passes each threshold.

    Returns:
        whether each pair was assigned, each true row got a detection, and each detection was taken.
    """
    columns = usable.shape[1]
    pair = np.zeros((len(truth), columns), bool)
    served, taken = np.zeros((len(frames), columns), bool), np.zeros((detections, columns), bool)
    order = np.lexsort((*reversed(preference), truth, frames[truth]))
    frame = frames[truth[order]]
    # the first pair of every frame, then the second one, and so on: no box occurs twice in a step
    place = np.arange(len(order)) - np.searchsorted(frame, frame)
    by_place = order[np.argsort(place, kind="stable")]
    for step in np.split(by_place, np.cumsum(np.bincount(place))[:-1]):
        row, candidate = truth[step], detection[step]
        pair[step] = assigned = usable[step] & ~served[row] & ~taken[candidate]
        served[row] |= assigned
        taken[candidate] |= assigned
    return pair, served, taken


@dataclass(frozen=True, eq=False)
class KittiRows(Table):
    """Columns as in the files (KITTI's units and coordinates: pixels, metres, radians, rectified camera 0).

    The rows of a frame are in the order of their file, since the first of two equally good boxes counts.

    Attributes:
        label: KITTI's `type`, not case-sensitive.
        truncated, occluded: of true rows.
        alpha: observation angle; -10 if unknown.
        edges: 2D box: left, top, right, bottom.
        size: of the 3D box: height, width, length; not positive if unknown.
        bottom: centre of the bottom face: x, y, z.
        rotation_y: about the camera's y axis.
        score: of detections; any number, higher means more confident.
    """

    truncated: Float64[np.ndarray, "n"]
    occluded: Float64[np.ndarray, "n"]
    alpha: Float64[np.ndarray, "n"]
    edges: Float64[np.ndarray, "n 4"]
    size: Float64[np.ndarray, "n 3"]
    bottom: Float64[np.ndarray, "n 3"]
    rotation_y: Float64[np.ndarray, "n"]
    score: Float64[np.ndarray, "n"]

    def is_of(self, *labels: str) -> Shaped[np.ndarray, "n"]:
        """A mask of the rows of these classes."""
        return np.isin(np.char.lower(self.label), [label.lower() for label in labels])

    @property
    def height_px(self) -> Float64[np.ndarray, "n"]:
        """Height of the 2D box."""
        return self.edges[:, 3] - self.edges[:, 1]

    @classmethod
    def from_table(
        cls, frame: Int64[np.ndarray, "n"], label: Shaped[np.ndarray, "n"], numbers: Float64[np.ndarray, "n 15"]
    ) -> KittiRows:
        """From the numeric columns in the order of the files: truncated to rotation_y, and the score."""
        truncated, occluded, alpha = numbers[:, :3].T
        edges, size, bottom = numbers[:, 3:7], numbers[:, 7:10], numbers[:, 10:13]
        return cls(frame, label, truncated, occluded, alpha, edges, size, bottom, numbers[:, 13], numbers[:, 14])


def covered_share(detections: KittiRows, areas: KittiRows) -> Float64[np.ndarray, "n"]:
    """The largest share of each detection's 2D box that one of the areas (DontCare) covers; not an IoU."""
    share = np.zeros(len(detections))
    for rows, columns in blocks_within(detections.frame, areas.frame):
        a, b = detections.take(rows), areas.take(columns)
        inner, area = _intersection_2d(a, b), _area_2d(a)
        np.maximum.at(share, rows, np.divide(inner, area, out=np.zeros(len(area)), where=inner > 0))
    return share


def _iou_2d(a: KittiRows, b: KittiRows) -> Float64[np.ndarray, "p"]:
    """IoU of the 2D boxes; the width of a box is right - left, without an additional pixel."""
    inner = _intersection_2d(a, b)
    return _ratio(inner, _area_2d(a) + _area_2d(b) - inner)


def _intersection_2d(a: KittiRows, b: KittiRows) -> Float64[np.ndarray, "p"]:
    sides = np.minimum(a.edges[:, 2:], b.edges[:, 2:]) - np.maximum(a.edges[:, :2], b.edges[:, :2])
    return np.asarray(np.maximum(sides, 0.0).prod(axis=1))


def _area_2d(rows: KittiRows) -> Float64[np.ndarray, "n"]:
    return np.asarray((rows.edges[:, 2:] - rows.edges[:, :2]).prod(axis=1))


def _iou_bev(a: KittiRows, b: KittiRows) -> Float64[np.ndarray, "p"]:
    """IoU of the ground rectangles: length x width in the x-z plane, rotated by rotation_y."""
    inner = _ground_intersection(a, b)
    return _ratio(inner, _ground(a).prod(axis=1) + _ground(b).prod(axis=1) - inner)


def _iou_3d(a: KittiRows, b: KittiRows) -> Float64[np.ndarray, "p"]:
    """IoU of the 3D boxes: intersection of the rectangles times that of the heights [y - h, y]; y points down."""
    floor, roof = np.minimum(a.bottom[:, 1], b.bottom[:, 1]), np.maximum(_roof(a), _roof(b))
    inner = _ground_intersection(a, b) * np.maximum(floor - roof, 0.0)
    return _ratio(inner, a.size.prod(axis=1) + b.size.prod(axis=1) - inner)


def _roof(rows: KittiRows) -> Float64[np.ndarray, "n"]:
    return rows.bottom[:, 1] - rows.size[:, 0]


def _ground(rows: KittiRows) -> Float64[np.ndarray, "n 2"]:
    """Length and width."""
    return rows.size[:, [2, 1]]


def _ground_intersection(a: KittiRows, b: KittiRows) -> Float64[np.ndarray, "p"]:
    """Intersection areas of the ground rectangles; 0 if a row has no 3D box."""
    apart = np.hypot(*(a.bottom[:, [0, 2]] - b.bottom[:, [0, 2]]).T)
    reach = 0.5 * (np.hypot(*_ground(a).T) + np.hypot(*_ground(b).T))
    near = (apart < reach) & (a.size > 0).all(axis=1) & (b.size > 0).all(axis=1)
    areas = np.zeros(len(a))
    a, b = a.take(near), b.take(near)
    # with x to the right and z up, rotation_y is clockwise
    sides = [(rows.bottom[:, [0, 2]], -rows.rotation_y, _ground(rows)) for rows in (a, b)]
    areas[near] = rectangle_intersection_pairs(*sides[0], *sides[1])
    return areas


def _ratio(inner: Float64[np.ndarray, "p"], union: Float64[np.ndarray, "p"]) -> Float64[np.ndarray, "p"]:
    return np.divide(inner, union, out=np.zeros(len(inner)), where=inner > 0)


DONT_CARE = "DontCare"
# Classes, and the similar classes on which a detection is not a false positive.
NEIGHBOURS: Mapping[str, tuple[str, ...]] = {"Car": ("Van",), "Pedestrian": ("Person_sitting",), "Cyclist": ()}

# Easy, moderate, hard.
DIFFICULTIES = ("easy", "moderate", "hard")
MIN_HEIGHT_PX = (40.0, 25.0, 25.0)
MAX_OCCLUSION = (0, 1, 2)
MAX_TRUNCATION = (0.15, 0.30, 0.50)

# Samples of a curve: recall 0, 1/40 ... 1.
SAMPLES = 41
# Values for "unknown" in a result file.
NO_ALPHA = -10.0
NO_PLACE_M = -1000.0
# The devkit's score of a missing detection; lower scores are never matched.
NO_DETECTION = -10_000_000.0


class Metric(StrEnum):
    """The metrics, by their names in the results."""

    BBOX = "bbox"
    BEV = "bev"
    BOX_3D = "3d"
    AOS = "aos"


# The IoU that a detection must exceed, by class. The relaxed ones are also often reported, e.g. by second.pytorch.
OFFICIAL = {"Car": 0.7, "Pedestrian": 0.5, "Cyclist": 0.5}
RELAXED = {"Car": 0.5, "Pedestrian": 0.25, "Cyclist": 0.25}


@dataclass(frozen=True, eq=False)
class KittiCurve:
    """Precision (orientation similarity for AOS) of one class, metric and difficulty.

    Attributes:
        samples: (41,), 0..1. Sample k is the best value at the k-th threshold and all later ones; 0 if there is no k-th
            threshold. It is not interpolated at recall k / 40.
        recall: at each threshold.
        objects: number of true objects that count.
        found: number of these objects that have a detection, of any score.
    """

    samples: Float64[np.ndarray, "41"]
    recall: Float64[np.ndarray, "k"]
    objects: int
    found: int

    @property
    def r11(self) -> float:
        """Average precision over 11 recalls, including 0 (used until 2019), percent."""
        return float(100.0 * self.samples[::4].mean())

    @property
    def r40(self) -> float:
        """Average precision over 40 recalls, excluding 0 (used since 2019), percent."""
        return float(100.0 * self.samples[1:].mean())


KittiResult = Mapping[str, Mapping[Metric, Sequence[KittiCurve]]]
"""The curves (easy, moderate, hard) by class and metric.

Classes without detections are omitted, and also metrics whose required values are missing in all detections of the
class. AOS is missing if any detection, of any class, has no observation angle.
"""


def evaluate_kitti(detections: KittiRows, truth: KittiRows, in_space: Mapping[str, float] = OFFICIAL) -> KittiResult:
    """Evaluates the detections of all frames (devkit: `main`, `eval_class`).

    Detections in frames without true rows count as false positives.

    Args:
        detections: with scores. Detections without a real 2D box are ignored in all metrics, because KITTI uses the
            height of the 2D box to ignore small objects.
        truth: labels, DontCare areas included.
        in_space: the IoU that a detection must exceed in bird's-eye view and in 3D; on the image, it is `OFFICIAL`.
    """
    metrics = {
        Metric.BBOX: (_iou_2d, OFFICIAL, detections.edges[:, 0] >= 0),
        Metric.BEV: (_iou_bev, in_space, detections.bottom[:, 0] != NO_PLACE_M),
        Metric.BOX_3D: (_iou_3d, in_space, detections.bottom[:, 1] != NO_PLACE_M),
    }
    oriented = bool((detections.alpha != NO_ALPHA).all())
    covered = covered_share(detections, truth.take(truth.is_of(DONT_CARE)))
    curves: dict[str, dict[Metric, Sequence[KittiCurve]]] = {}
    for metric, (measure, needed, has_values) in metrics.items():
        overlaps = overlapping(detections, truth, measure)
        for label in NEIGHBOURS:
            if not (detections.is_of(label) & has_values).any():
                continue
            excused = covered > needed[label] if metric is Metric.BBOX else np.zeros(len(detections), bool)
            evaluation = _ClassEvaluation(detections, truth, label, needed[label], overlaps, excused)
            precision, similarity = zip(*map(evaluation.curves, range(len(DIFFICULTIES))), strict=True)
            of_class = curves.setdefault(label, {})
            of_class[metric] = precision
            if metric is Metric.BBOX and oriented:
                of_class[Metric.AOS] = similarity
    return curves


@dataclass(frozen=True, eq=False)
class _ClassEvaluation:
    """The evaluation of one class and metric; unmatched `excused` detections are not false positives."""

    detections: KittiRows
    truth: KittiRows
    label: str
    needed: float
    overlaps: BoxPairs
    excused: Bool[np.ndarray, "d"]

    def curves(self, level: int) -> tuple[KittiCurve, KittiCurve]:
        """Precision and orientation similarity at one difficulty."""
        counts, takes_part = self._true_rows(level)
        valid, competes = self._detected_rows(level)
        rows, columns, iou = self.overlaps.detection, self.overlaps.truth, self.overlaps.iou
        enough = (iou > self.needed) & competes[rows] & takes_part[columns]
        rows, columns, iou = rows[enough], columns[enough], iou[enough]
        score, right = self.detections.score[rows], counts[columns] & valid[rows]
        # first pass, without a threshold: prefer the highest score, including small detections of any class
        sides = (columns, rows, self.truth.frame, len(self.detections))
        chosen, _, _ = assign(*sides, (-score, rows), (score > NO_DETECTION)[:, None])
        scores, objects = score[chosen[:, 0] & right], int(counts.sum())
        thresholds = score_thresholds(scores, objects)
        # second pass: prefer the largest overlap; small detections come last
        preference = (~valid[rows], np.where(valid[rows], -iou, 0.0), rows)
        chosen, served, taken = assign(*sides, preference, score[:, None] >= thresholds)
        hits = chosen & right[:, None]
        similarity = 0.5 * (1.0 + np.cos(self.truth.alpha[columns] - self.detections.alpha[rows]))
        false = valid & ~self.excused
        wrong = ((self.detections.score[false][:, None] >= thresholds) & ~taken[false]).sum(axis=0)
        detected, missed = hits.sum(axis=0), (counts[:, None] & ~served).sum(axis=0)
        recall = _share(detected, detected + missed)
        return (
            KittiCurve(_samples(_share(detected, detected + wrong)), recall, objects, len(scores)),
            KittiCurve(_samples(_share(similarity @ hits, detected + wrong)), recall, objects, len(scores)),
        )

    def _true_rows(self, level: int) -> tuple[Bool[np.ndarray, "g"], Bool[np.ndarray, "g"]]:
        """Which true rows count, and which are matched; rows matched without counting are neither TP nor FP."""
        of_class, neighbour = self.truth.is_of(self.label), self.truth.is_of(*NEIGHBOURS[self.label])
        hard = (
            (self.truth.occluded > MAX_OCCLUSION[level])
            | (self.truth.truncated > MAX_TRUNCATION[level])
            | (self.truth.height_px <= MIN_HEIGHT_PX[level])
        )
        return of_class & ~hard, of_class | neighbour

    def _detected_rows(self, level: int) -> tuple[Bool[np.ndarray, "d"], Bool[np.ndarray, "d"]]:
        """Which detections count, and which take part in the matching (also small ones of any class).

        A true row whose height equals the limit is too small; a detection is not.
        """
        small = np.abs(self.detections.height_px) < MIN_HEIGHT_PX[level]
        of_class = self.detections.is_of(self.label)
        return of_class & ~small, of_class | small


def score_thresholds(scores: Float64[np.ndarray, "k"], objects: int) -> Float64[np.ndarray, "t"]:
    """The scores at which a curve is sampled: those nearest to recall 0, 1/40, 2/40 ... (devkit: `getThresholds`).

    Args:
        scores: of the true positives of the first pass.
        objects: number of true objects that count.
    """
    chosen, recall = [], 0.0
    ordered = np.sort(scores)[::-1]
    for number, score in enumerate(ordered.tolist(), 1):
        is_last = number == len(ordered)
        if not is_last and (number + 1) / objects - recall < recall - number / objects:
            continue
        chosen.append(score)
        recall += 1.0 / (SAMPLES - 1)
    return np.array(chosen, np.float64)


def _samples(values: Float64[np.ndarray, "t"]) -> Float64[np.ndarray, "41"]:
    """The running maximum from the end, padded with 0."""
    samples = np.zeros(SAMPLES)
    samples[: len(values)] = np.maximum.accumulate(values[::-1])[::-1]
    return samples


def _share(part: Shaped[np.ndarray, "t"], whole: Int[np.ndarray, "t"]) -> Float64[np.ndarray, "t"]:
    """part / whole; 0 for an empty whole."""
    return np.divide(part, whole, out=np.zeros(len(whole)), where=whole > 0)
