"""From raw predictions to candidates: small examples, and a property test against a loop."""

from __future__ import annotations

import numpy as np
import pytest

from annotator.detection.yolo import MAX_CANDIDATES, candidates


def test_centre_and_size_become_edges_and_the_best_class_counts() -> None:
    raw = np.zeros((2, 6, 4), np.float32)
    raw[0, :, 3] = [10, 20, 4, 6, 0.4, 0.3]
    raw[1, :, 0] = [5, 5, 2, 2, 0.2, 0.9]
    selected = candidates(raw, False, 0.05)
    assert selected.picture.tolist() == [0, 1]
    assert selected.boxes.tolist() == [[8, 17, 12, 23], [4, 4, 6, 6]]
    assert selected.numbers.tolist() == [0, 1]
    np.testing.assert_allclose(selected.scores, [0.4, 0.9])


def test_an_end_to_end_box_may_be_a_candidate_of_two_classes() -> None:
    """With as many anchors as rows, so that swapped axes would still have valid shapes."""
    raw = np.zeros((1, 6, 6), np.float32)
    raw[0, :, 2] = [1, 2, 11, 12, 0.4, 0.3]
    selected = candidates(raw, True, 0.05)
    assert selected.boxes.tolist() == [[1, 2, 11, 12]] * 2
    assert sorted(zip(selected.numbers.tolist(), (10 * selected.scores).round().tolist(), strict=True)) == [
        (0, 4),
        (1, 3),
    ]


def test_scores_below_the_threshold_give_no_candidates() -> None:
    selected = candidates(np.zeros((3, 5, 7), np.float32), False, 0.0)
    assert selected.boxes.shape == (0, 4)
    assert len(selected.picture) == len(selected.scores) == len(selected.numbers) == 0


@pytest.mark.parametrize("end2end", [False, True])
def test_only_the_best_of_each_image_are_kept(end2end: bool) -> None:
    rng = np.random.default_rng(0)
    raw = rng.random((3, 6, 500), np.float32)
    raw[1, 4:] *= rng.random(500) < 0.1  # one image has few
    selected = candidates(raw, end2end, 0.1)
    for picture in range(3):
        scores = raw[picture, 4:] if end2end else raw[picture, 4:].max(axis=0)
        best = np.sort(scores[scores > 0.1])[::-1][:MAX_CANDIDATES]
        np.testing.assert_array_equal(np.sort(selected.scores[selected.picture == picture])[::-1], best)


@pytest.mark.parametrize("end2end", [False, True])
def test_spreads_go_with_their_boxes_and_are_no_classes(end2end: bool) -> None:
    raw = np.zeros((1, 10, 3), np.float32)
    raw[0, :6, 1] = [10, 20, 14, 26, 0.4, 0.3]
    raw[0, 6:, :] = [[7, 1, 8], [7, 2, 8], [7, 3, 8], [7, 4, 8]]
    selected = candidates(raw, end2end, 0.35, edge_spread=True)
    assert selected.numbers.tolist() == [0]
    assert selected.spreads is not None and selected.spreads.tolist() == [[1, 2, 3, 4]]
    assert candidates(raw[:, :6], end2end, 0.35).spreads is None
