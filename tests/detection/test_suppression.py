"""Greedy suppression of overlapping boxes."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from annotator.detection.yolo import suppress


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    shared = max(width, 0) * max(height, 0)
    return shared / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - shared)


def suppress_in_loops(boxes: np.ndarray, scores: np.ndarray, groups: np.ndarray, iou: float) -> list[int]:
    """Reference implementation of the definition, one pair at a time."""
    kept: list[int] = []
    for i in sorted(range(len(boxes)), key=lambda i: (-scores[i], i)):
        if all(groups[i] != groups[k] or overlap(boxes[i], boxes[k]) <= iou for k in kept):
            kept.append(i)
    return kept


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6), count=st.integers(0, 40), iou=st.sampled_from([0.0, 0.3, 0.6, 1.0]), ties=st.booleans()
)
def test_suppression_agrees_with_the_definition(seed: int, count: int, iou: float, ties: bool) -> None:
    rng = np.random.default_rng(seed)
    low = rng.uniform(0, 30, (count, 2))
    boxes = np.concatenate([low, low + rng.uniform(1, 25, (count, 2))], axis=1)
    scores = np.round(rng.random(count), 1 if ties else 6)
    groups = rng.integers(0, 3, count)
    assert suppress(boxes, scores, groups, iou).tolist() == suppress_in_loops(boxes, scores, groups, iou)


def test_only_boxes_of_the_same_group_suppress_each_other() -> None:
    boxes = np.array([[0.0, 0, 10, 10], [1, 0, 11, 10], [0, 0, 10, 10]])
    assert suppress(boxes, np.array([0.5, 0.9, 0.3]), np.array([0, 0, 1]), 0.5).tolist() == [1, 2]
