"""The yardstick for fully oriented boxes: average precision with exact 3D IoU, mean IoU, and errors of the poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from annotator.evaluation.average_precision import PrecisionRecall, precision_recall
from annotator.evaluation.boxes import BoxTable, overlapping
from annotator.evaluation.oriented import assigned
from annotator.evaluation.poses import pose_errors

THRESHOLDS = (0.25, 0.5, 0.7)
# Poses are compared where a box and a true one overlap by more than this; below, an angle says nothing.
POSE_IOU = 0.25


@dataclass(frozen=True)
class OrientedClass:
    """One class.

    Attributes:
        curves: by IoU threshold.
        objects, detections: how many there are.
        matched: pairs whose poses were compared: assigned to each other, IoU above `POSE_IOU`.
        mean_iou: over all true boxes, 0 for those that nothing is assigned to.
        center_error_m, rotation_error_rad, size_error: means over the matched pairs (see `pose_errors`); NaN
            without any.
    """

    curves: Mapping[float, PrecisionRecall]
    objects: int
    detections: int
    matched: int
    mean_iou: float
    center_error_m: float
    rotation_error_rad: float
    size_error: float


@dataclass(frozen=True)
class OrientedResult:
    """The classes that have a true box."""

    classes: Mapping[str, OrientedClass]

    def mean(self, threshold: float) -> float:
        """Mean average precision over the classes, 0..1; NaN without any."""
        areas = [found.curves[threshold].area for found in self.classes.values()]
        return float(np.mean(areas)) if areas else float("nan")


def evaluate_oriented(
    detections: BoxTable, truth: BoxTable, thresholds: Sequence[float] = THRESHOLDS
) -> OrientedResult:
    """Evaluates the detections of all frames, class by class."""
    labels = np.unique(truth.label).tolist()
    return OrientedResult(
        {label: _class(detections.of_class(label), truth.of_class(label), thresholds) for label in labels}
    )


def _class(detections: BoxTable, truth: BoxTable, thresholds: Sequence[float]) -> OrientedClass:
    pairs, counts = overlapping(detections, truth), np.ones(len(truth), bool)
    chosen = assigned(pairs, truth.frame)
    near = chosen.take(chosen.iou > POSE_IOU)
    errors = pose_errors(detections.take(near.detection), truth.take(near.truth))
    return OrientedClass(
        curves={threshold: precision_recall(detections.score, pairs, counts, threshold) for threshold in thresholds},
        objects=len(truth),
        detections=len(detections),
        matched=len(near.iou),
        mean_iou=float(chosen.iou.sum() / len(truth)),
        center_error_m=_mean(errors.center_m),
        rotation_error_rad=_mean(errors.rotation_rad),
        size_error=_mean(errors.size),
    )


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else float("nan")
