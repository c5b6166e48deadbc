"""Average precision on small cases computed by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from annotator.evaluation.oriented import FrameResult, average_precision, matched_ious
from annotator.types import OrientedBox


def box(x: float, size: float = 1.0) -> OrientedBox:
    return OrientedBox.from_parts(np.array([x, 0.0, 5.0]), np.eye(3), np.full(3, size))


CASES = [
    pytest.param([box(0)], [0.5], [box(0)], [], 1.0, id="found"),
    pytest.param([], [], [box(0)], [], 0.0, id="missed"),
    pytest.param([box(9)], [0.5], [box(0)], [], 0.0, id="beside"),
    pytest.param([box(9), box(0)], [0.9, 0.5], [box(0)], [], 0.5, id="wrong-one-first"),
    pytest.param([box(0), box(9)], [0.9, 0.5], [box(0)], [], 1.0, id="wrong-one-last"),
    pytest.param([box(0), box(0), box(5)], [0.9, 0.8, 0.7], [box(0), box(5)], [], 0.5 + 0.5 * 2 / 3, id="found-twice"),
    pytest.param([box(9), box(0)], [0.9, 0.5], [box(0)], [box(9)], 1.0, id="on-an-ignored"),
    pytest.param([box(9), box(9), box(0)], [0.9, 0.8, 0.5], [box(0)], [box(9)], 1.0, id="twice-on-an-ignored"),
    pytest.param([box(9.5), box(0)], [0.9, 0.5], [box(0)], [box(9)], 0.5, id="too-far-from-an-ignored"),
    pytest.param([box(0.1), box(7)], [0.9, 0.5], [box(0)], [box(0.4)], 1.0, id="nearer-to-the-one-that-counts"),
    pytest.param([box(9)], [0.9], [box(0)], [box(9)], 0.0, id="only-an-ignored-found"),
]


@pytest.mark.parametrize(("boxes", "scores", "truth", "ignored", "expected"), CASES)
def test_average_precision_equals_the_value_computed_by_hand(
    boxes: list[OrientedBox],
    scores: list[float],
    truth: list[OrientedBox],
    ignored: list[OrientedBox],
    expected: float,
) -> None:
    assert average_precision([FrameResult(boxes, scores, truth, ignored)], 0.5) == pytest.approx(expected)


def test_average_precision_without_true_boxes_is_nan() -> None:
    assert math.isnan(average_precision([FrameResult([box(0)], [1.0], [], [box(0)])], 0.5))


def test_frames_are_pooled_and_objects_of_other_frames_do_not_count() -> None:
    first, second = FrameResult([box(0)], [0.5], [box(0)]), FrameResult([box(0)], [0.9], [box(5)])
    # the false positive has the higher score: recall 1/2 at precision 1/2
    assert average_precision([first, second], 0.5) == pytest.approx(0.25)


def test_ignored_boxes_are_not_matched() -> None:
    np.testing.assert_allclose(matched_ious(FrameResult([box(9)], [1.0], [box(0)], [box(9)])), [0.0])
