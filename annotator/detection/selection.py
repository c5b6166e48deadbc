"""Decodes the raw output of a network into candidate boxes, for a whole batch at once and for every backend."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64

# Only the candidates with the highest scores of an image enter non-maximum suppression.
MAX_CANDIDATES = 300


@dataclass(frozen=True, eq=False)
class Candidates:
    """The candidates of a batch before non-maximum suppression.

    Attributes:
        picture: (k,) index of the image in its batch.
        boxes: (k, 4) x_min y_min x_max y_max, pixels from the corner of the batch's canvas.
        scores: (k,) 0..1.
        numbers: (k,) class numbers.
        spreads: (k, 4) spread of each edge in the order of `boxes`, pixels; None if the network gives none.
    """

    picture: Int64[np.ndarray, "k"]
    boxes: Float32[np.ndarray, "k 4"]
    scores: Float32[np.ndarray, "k"]
    numbers: Int64[np.ndarray, "k"]
    spreads: Float32[np.ndarray, "k 4"] | None = None


def candidates(
    prediction: Float32[np.ndarray, "n c a"], end2end: bool, confidence: float, edge_spread: bool = False
) -> Candidates:
    """The candidates of each image whose score exceeds `confidence`, at most `MAX_CANDIDATES` per image.

    Args:
        prediction: one column per anchor: four numbers of its box, the score of each class, and the spread of each edge
            if `edge_spread`. The box is centre and size, or x_min y_min x_max y_max if `end2end`.
        end2end: whether the network works without suppression (YOLO26, YOLOv10).
        confidence: score threshold.
        edge_spread: as in `NetworkFacts`.
    """
    classes = prediction[:, 4:-4] if edge_spread else prediction[:, 4:]
    if end2end:  # as in ultralytics, one anchor may give boxes of two classes
        picture, number, anchor = np.nonzero(classes > confidence)
    else:
        best = classes.max(axis=1)
        picture, anchor = np.nonzero(best > confidence)
        number = classes[picture, :, anchor].argmax(axis=1)
    scores = classes[picture, number, anchor]
    kept = _best_of_each(picture, scores)
    picture, number, anchor, scores = picture[kept], number[kept], anchor[kept], scores[kept]
    boxes = prediction[picture, :4, anchor]
    if not end2end:
        middle, half = boxes[:, :2], boxes[:, 2:] / 2
        boxes = np.concatenate([middle - half, middle + half], axis=1)
    spreads = prediction[picture, -4:, anchor] if edge_spread else None
    return Candidates(picture, boxes, scores, number, spreads)


def _best_of_each(picture: Int64[np.ndarray, "k"], scores: Float[np.ndarray, "k"]) -> Bool[np.ndarray, "k"]:
    """Mask of the candidates that are among the best `MAX_CANDIDATES` of their image."""
    counts = np.bincount(picture)
    if len(counts) == 0 or counts.max() <= MAX_CANDIDATES:
        return np.ones(len(picture), bool)
    order = np.lexsort((-scores, picture))
    begins = np.cumsum(counts) - counts
    kept = np.empty(len(picture), bool)
    kept[order] = np.arange(len(picture)) - begins[picture[order]] < MAX_CANDIDATES
    return kept
