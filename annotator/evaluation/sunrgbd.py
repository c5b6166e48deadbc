"""SUN RGB-D's 3D detection benchmark as in VoteNet (`utils/eval_det.py`, area under the envelope)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from annotator.evaluation.boxes import BoxTable, overlapping
from annotator.evaluation.oriented import PrecisionRecall, precision_recall

THRESHOLDS = (0.15, 0.25, 0.5)


@dataclass(frozen=True)
class SunRgbdResult:
    """The curves by IoU threshold and class; classes without a true box are not evaluated.

    Attributes:
        objects, detections: number of true boxes and of detections, by class.
    """

    curves: Mapping[float, Mapping[str, PrecisionRecall]]
    objects: Mapping[str, int]
    detections: Mapping[str, int]

    def mean(self, threshold: float) -> float:
        """Mean average precision over the classes, 0..1; NaN without classes."""
        areas = [curve.area for curve in self.curves[threshold].values()]
        return float(np.mean(areas)) if areas else float("nan")


def evaluate_sunrgbd(detections: BoxTable, truth: BoxTable, thresholds: Sequence[float] = THRESHOLDS) -> SunRgbdResult:
    """Evaluates the detections of all frames, class by class.

    VoteNet intersects upright boxes. The exact intersection used here gives the same result for them, and is also
    defined for tilted boxes.

    Args:
        detections: with scores; those in frames without a true box count as false positives.
        truth: true boxes.
    """
    curves: dict[float, dict[str, PrecisionRecall]] = {threshold: {} for threshold in thresholds}
    objects, numbers = {}, {}
    for label in np.unique(truth.label).tolist():
        detected, true = detections.of_class(label), truth.of_class(label)
        objects[label], numbers[label] = len(true), len(detected)
        pairs, counts = overlapping(detected, true), np.ones(len(true), bool)
        for threshold in thresholds:
            curves[threshold][label] = precision_recall(detected.score, pairs, counts, threshold)
    return SunRgbdResult(curves, objects, numbers)
