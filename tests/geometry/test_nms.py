"""Class-wise greedy suppression."""

from __future__ import annotations

import numpy as np
import pytest
from geometry_strategies import random_boxes
from hypothesis import given, settings
from hypothesis import strategies as st

from annotator.geometry.iou import iou_3d_matrix, nms_3d
from annotator.types import OrientedBox
from annotator.types.errors import GeometryError


def cube(x: float) -> OrientedBox:
    return OrientedBox.from_parts(np.array([x, 0.0, 0.0]), np.eye(3), np.ones(3))


# IoU of neighbours 0.2 apart: 0.8 / 1.2 = 0.667; 0.4 apart: 0.6 / 1.4 = 0.429
ROW = [cube(0.0), cube(0.2), cube(0.4), cube(5.0)]


@pytest.mark.parametrize(
    ("scores", "labels", "threshold", "kept"),
    [
        ((0.9, 0.8, 0.7, 0.6), "aaaa", 0.5, [0, 2, 3]),  # a dropped box suppresses nothing
        ((0.8, 0.9, 0.7, 0.6), "aaaa", 0.5, [1, 3]),
        ((0.9, 0.8, 0.7, 0.6), "aaaa", 0.3, [0, 3]),
        ((0.9, 0.8, 0.7, 0.6), "aaaa", 0.7, [0, 1, 2, 3]),
        ((0.9, 0.8, 0.7, 0.6), "abaa", 0.5, [0, 1, 2, 3]),  # boxes of different classes do not suppress each other
        ((0.5, 0.5, 0.5, 0.5), "aaaa", 0.5, [0, 2, 3]),  # ties: the lower index wins
        ((0.5, 0.5, 0.5, 0.6), "aaaa", 0.3, [3, 0]),
        ((0.1, 0.2, 0.3, 0.4), "abab", 0.3, [3, 2, 1]),
    ],
)
def test_overlapping_boxes_of_a_class_are_suppressed_by_score(
    scores: tuple[float, ...], labels: str, threshold: float, kept: list[int]
) -> None:
    assert nms_3d(ROW, np.array(scores), list(labels), threshold).tolist() == kept


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 1000), st.integers(0, 25), st.floats(0.05, 0.9))
def test_a_box_is_dropped_exactly_if_a_better_kept_box_overlaps_it(seed: int, count: int, threshold: float) -> None:
    """Kept boxes do not overlap above the threshold; each dropped box overlaps a better kept box of its class."""
    rng = np.random.default_rng(seed)
    some = random_boxes(count, seed)
    scores = rng.integers(0, 5, count) / 4.0
    labels = ["ab"[k] for k in rng.integers(0, 2, count)]
    kept = nms_3d(some, scores, labels, threshold).tolist()
    iou = iou_3d_matrix(some, some)
    same = np.array([[p == q for q in labels] for p in labels]).reshape(count, count)
    ranks = [(-scores[i], i) for i in range(count)]
    assert [ranks[i] for i in kept] == sorted(ranks[i] for i in kept)
    for i in range(count):
        above = [j for j in kept if j != i and same[i, j] and iou[i, j] > threshold and ranks[j] < ranks[i]]
        assert bool(above) == (i not in kept)


@pytest.mark.parametrize(
    ("scores", "labels", "message"),
    [([0.5], ["a"] * 4, "one score"), ([0.5] * 4, ["a"], "one label"), ([np.nan, 1, 1, 1], ["a"] * 4, "finite")],
)
def test_invalid_scores_are_refused(scores: list[float], labels: list[str], message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        nms_3d(ROW, np.array(scores, np.float64), labels, 0.5)
