"""From a network's raw answer to boxes; for a whole batch of pictures at once, whatever has run the network."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64

# Only the most certain candidates of a picture are compared for overlap.
MAX_CANDIDATES = 300


@dataclass(frozen=True, eq=False)
class Candidates:
    """What a batch's raw answer amounts to before boxes are compared with each other.

    Attributes:
        picture: (k,) number of the picture in its batch.
        boxes: (k, 4) x_min y_min x_max y_max, pixels from the batch's corner.
        scores: (k,)
        numbers: (k,) class numbers.
    """

    picture: Int64[np.ndarray, "k"]
    boxes: Float32[np.ndarray, "k 4"]
    scores: Float32[np.ndarray, "k"]
    numbers: Int64[np.ndarray, "k"]


def candidates(prediction: Float32[np.ndarray, "n c a"], end2end: bool, confidence: float) -> Candidates:
    """The candidates of each picture that are certain enough, at most `MAX_CANDIDATES` of them.

    Args:
        prediction: a column an anchor: four numbers of its box, then the score of each class. The box is centre and
            size; of networks that answer each object once (end2end: YOLO26, YOLOv10) x_min y_min x_max y_max.
        end2end: which of the two it is.
        confidence: a box with a lower score is none.
    """
    if end2end:  # as ultralytics ranks them: a box may count for two classes
        picture, number, anchor = np.nonzero(prediction[:, 4:] > confidence)
    else:
        best = prediction[:, 4:].max(axis=1)
        picture, anchor = np.nonzero(best > confidence)
        number = prediction[picture, 4:, anchor].argmax(axis=1)
    scores = prediction[picture, 4 + number, anchor]
    kept = _best_of_each(picture, scores)
    picture, number, anchor, scores = picture[kept], number[kept], anchor[kept], scores[kept]
    boxes = prediction[picture, :4, anchor]
    if not end2end:
        middle, half = boxes[:, :2], boxes[:, 2:] / 2
        boxes = np.concatenate([middle - half, middle + half], axis=1)
    return Candidates(picture, boxes, scores, number)


def _best_of_each(picture: Int64[np.ndarray, "k"], scores: Float[np.ndarray, "k"]) -> Bool[np.ndarray, "k"]:
    """Which of the candidates are among the first `MAX_CANDIDATES` of their picture, best score first."""
    counts = np.bincount(picture)
    if len(counts) == 0 or counts.max() <= MAX_CANDIDATES:
        return np.ones(len(picture), bool)
    order = np.lexsort((-scores, picture))
    begins = np.cumsum(counts) - counts
    kept = np.empty(len(picture), bool)
    kept[order] = np.arange(len(picture)) - begins[picture[order]] < MAX_CANDIDATES
    return kept
