"""KITTI's evaluation: rows that count, precision at the sampled recalls, average precision."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float64, Int, Shaped

from annotator.evaluation.kitti.matching import assign
from annotator.evaluation.kitti.overlap import Overlaps, covered_share, overlaps_2d, overlaps_3d, overlaps_bev
from annotator.evaluation.kitti.rows import KittiRows

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


@dataclass(frozen=True)
class MinOverlap:
    """The IoU that a detection must exceed, by class: on the image (AOS too), in bird's-eye view, in 3D."""

    bbox: Mapping[str, float]
    bev: Mapping[str, float]
    box_3d: Mapping[str, float]


_STRICT = {"Car": 0.7, "Pedestrian": 0.5, "Cyclist": 0.5}
_LOOSE = {"Car": 0.5, "Pedestrian": 0.25, "Cyclist": 0.25}
OFFICIAL = MinOverlap(_STRICT, _STRICT, _STRICT)
# Also often reported, e.g. by second.pytorch; the thresholds on the image are the official ones.
RELAXED = MinOverlap(_STRICT, _LOOSE, _LOOSE)


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


@dataclass(frozen=True)
class KittiResult:
    """The curves (easy, moderate, hard) by class and metric.

    Classes without detections are omitted, and also metrics whose required values are missing in all detections of the
    class. AOS is missing if any detection, of any class, has no observation angle.
    """

    curves: Mapping[str, Mapping[Metric, tuple[KittiCurve, KittiCurve, KittiCurve]]]


def evaluate_kitti(detections: KittiRows, truth: KittiRows, min_overlap: MinOverlap = OFFICIAL) -> KittiResult:
    """Evaluates the detections of all frames (devkit: `main`, `eval_class`).

    Detections in frames without true rows count as false positives.

    Args:
        detections: with scores. Detections without a real 2D box are ignored in all metrics, because KITTI uses the
            height of the 2D box to ignore small objects.
        truth: labels, DontCare areas included.
    """
    detections, truth = detections.by_frame(), truth.by_frame()
    metrics = {
        Metric.BBOX: (overlaps_2d, min_overlap.bbox, detections.edges[:, 0] >= 0),
        Metric.BEV: (overlaps_bev, min_overlap.bev, detections.bottom[:, 0] != NO_PLACE_M),
        Metric.BOX_3D: (overlaps_3d, min_overlap.box_3d, detections.bottom[:, 1] != NO_PLACE_M),
    }
    oriented = bool((detections.alpha != NO_ALPHA).all())
    covered = covered_share(detections, truth.take(truth.is_of(DONT_CARE)))
    curves: dict[str, dict[Metric, tuple[KittiCurve, KittiCurve, KittiCurve]]] = {}
    for metric, (measure, needed, has_values) in metrics.items():
        overlaps = measure(detections, truth)
        for label in NEIGHBOURS:
            if not (detections.is_of(label) & has_values).any():
                continue
            excused = covered > needed[label] if metric is Metric.BBOX else np.zeros(len(detections), bool)
            evaluation = _ClassEvaluation(detections, truth, label, needed[label], overlaps, excused)
            levels = [evaluation.curves(level) for level in range(len(DIFFICULTIES))]
            of_class = curves.setdefault(label, {})
            of_class[metric] = (levels[0][0], levels[1][0], levels[2][0])
            if metric is Metric.BBOX and oriented:
                of_class[Metric.AOS] = (levels[0][1], levels[1][1], levels[2][1])
    return KittiResult(curves)


@dataclass(frozen=True, eq=False)
class _ClassEvaluation:
    """The evaluation of one class and metric; unmatched `excused` detections are not false positives."""

    detections: KittiRows
    truth: KittiRows
    label: str
    needed: float
    overlaps: Overlaps
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
        chosen, _, _ = self._assigned(rows, columns, (-score, rows), (score > NO_DETECTION)[:, None])
        scores, objects = score[chosen[:, 0] & right], int(counts.sum())
        thresholds = score_thresholds(scores, objects)
        # second pass: prefer the largest overlap; small detections come last
        preference = (~valid[rows], np.where(valid[rows], -iou, 0.0), rows)
        chosen, served, taken = self._assigned(rows, columns, preference, score[:, None] >= thresholds)
        hits = chosen & right[:, None]
        similarity = 0.5 * (1.0 + np.cos(self.truth.alpha[columns] - self.detections.alpha[rows]))
        wrong = self._wrong(valid & ~self.excused, taken, thresholds)
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

    def _assigned(
        self,
        rows: Int[np.ndarray, "p"],
        columns: Int[np.ndarray, "p"],
        preference: tuple[Shaped[np.ndarray, "p"], ...],
        usable: Bool[np.ndarray, "p t"],
    ) -> tuple[Bool[np.ndarray, "p t"], Bool[np.ndarray, "g t"], Bool[np.ndarray, "d t"]]:
        """`assign` on the rows that occur in pairs; the result is expanded to all rows."""
        paired_rows, row_numbers = np.unique(rows, return_inverse=True)
        paired_columns, column_numbers = np.unique(columns, return_inverse=True)
        assignment = assign(column_numbers, row_numbers, self.truth.frame[columns], preference, usable)
        served = np.zeros((len(self.truth), usable.shape[1]), bool)
        taken = np.zeros((len(self.detections), usable.shape[1]), bool)
        served[paired_columns], taken[paired_rows] = assignment.truth, assignment.detection
        return assignment.pair, served, taken

    def _wrong(
        self, valid: Bool[np.ndarray, "d"], taken: Bool[np.ndarray, "d t"], thresholds: Float64[np.ndarray, "t"]
    ) -> Int[np.ndarray, "t"]:
        above = self.detections.score[valid][:, None] >= thresholds
        return np.asarray((above & ~taken[valid]).sum(axis=0))


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
