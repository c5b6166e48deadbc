"""Average precision as the area under the precision envelope (PASCAL VOC since 2010), over all frames together.

Detections are processed in order of descending score. Each is compared only with the true box of its frame that it
overlaps most. It is a true positive if the IoU is above the threshold and the box has not been matched before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from annotator.evaluation.boxes import BoxPairs


@dataclass(frozen=True, eq=False)
class PrecisionRecall:
    """Precision and recall after each detection, in order of descending score; both 0..1."""

    recall: Float64[np.ndarray, "n"]
    precision: Float64[np.ndarray, "n"]

    @property
    def area(self) -> float:
        """Average precision, 0..1: the area under the envelope, the best precision at this or any higher recall."""
        recall = np.concatenate([[0.0], self.recall, [1.0]])
        precision = np.concatenate([[0.0], self.precision, [0.0]])
        envelope = np.maximum.accumulate(precision[::-1])[::-1]
        return float(np.sum(np.diff(recall) * envelope[1:]))

    @property
    def final_recall(self) -> float:
        """The share of the true boxes that were detected."""
        return float(self.recall[-1]) if len(self.recall) else 0.0


def precision_recall(
    score: Float64[np.ndarray, "d"], pairs: BoxPairs, counts: Bool[np.ndarray, "g"], iou_threshold: float
) -> PrecisionRecall:
    """The curve of one class.

    Args:
        score: of each detection; equal scores are processed in the order of the rows.
        pairs: the overlapping pairs of detections and true boxes.
        counts: whether each true box counts; at least one must. Detections of the others are neither true nor false
            positives.
        iou_threshold: a match needs a larger IoU.
    """
    best = pairs.best()
    best = best.take(best.iou > iou_threshold)
    target = np.full(len(score), -1)
    target[best.detection] = best.truth
    order = np.argsort(-score, kind="stable")
    target = target[order]
    target = target[(target < 0) | counts[target]]
    hits = np.zeros(len(target), bool)
    hits[np.unique(target, return_index=True)[1]] = True
    hits &= target >= 0
    true_positives = np.cumsum(hits)
    return PrecisionRecall(true_positives / counts.sum(), true_positives / np.arange(1, len(hits) + 1))
