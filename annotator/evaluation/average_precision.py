"""Average precision as the area under the precision envelope (PASCAL VOC 2010 on), frames pooled.

Detections in descending score each look at the true box of their frame that they overlap most, taken or not; a hit
needs IoU above the threshold and a box not yet taken, there is no second choice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from annotator.evaluation.boxes import BoxPairs


@dataclass(frozen=True, eq=False)
class PrecisionRecall:
    """Precision and recall after each detection, the surest first; both 0..1."""

    recall: Float64[np.ndarray, "n"]
    precision: Float64[np.ndarray, "n"]

    @property
    def area(self) -> float:
        """Average precision: the area under the envelope, the best precision at this recall or any above; 0..1."""
        recall = np.concatenate([[0.0], self.recall, [1.0]])
        precision = np.concatenate([[0.0], self.precision, [0.0]])
        envelope = np.maximum.accumulate(precision[::-1])[::-1]
        return float(np.sum(np.diff(recall) * envelope[1:]))

    @property
    def final_recall(self) -> float:
        """The share of the true boxes that were found at all."""
        return float(self.recall[-1]) if len(self.recall) else 0.0


def precision_recall(
    score: Float64[np.ndarray, "d"], pairs: BoxPairs, counts: Bool[np.ndarray, "g"], iou_threshold: float
) -> PrecisionRecall:
    """The curve of one class.

    Args:
        score: of each detection; of equal ones the first row comes first.
        pairs: which detections and true boxes overlap.
        counts: for each true box, whether it is asked for; to find one that is not is neither right nor wrong. At
            least one must count.
    """
    best = pairs.best()
    best = best.take(best.iou > iou_threshold)
    looked_at = np.full(len(score), -1)
    looked_at[best.detection] = best.truth
    order = np.argsort(-score, kind="stable")
    looked_at = looked_at[order]
    looked_at = looked_at[(looked_at < 0) | counts[looked_at]]
    hits = np.zeros(len(looked_at), bool)
    hits[np.unique(looked_at, return_index=True)[1]] = True
    hits &= looked_at >= 0
    found = np.cumsum(hits)
    return PrecisionRecall(found / counts.sum(), found / np.arange(1, len(hits) + 1))
