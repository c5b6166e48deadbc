"""From raw predictions to candidates; tables small enough to see, and a law against a loop."""

from __future__ import annotations

import numpy as np
import pytest

from annotator.detection.selection import MAX_CANDIDATES, candidates


def test_centre_and_size_become_edges_and_the_best_class_counts() -> None:
    raw = np.zeros((2, 6, 4), np.float32)
    raw[0, :, 3] = [10, 20, 4, 6, 0.4, 0.3]
    raw[1, :, 0] = [5, 5, 2, 2, 0.2, 0.9]
    found = candidates(raw, False, 0.05)
    assert found.picture.tolist() == [0, 1]
    assert found.boxes.tolist() == [[8, 17, 12, 23], [4, 4, 6, 6]]
    assert found.numbers.tolist() == [0, 1]
    np.testing.assert_allclose(found.scores, [0.4, 0.9])


def test_of_networks_that_answer_once_a_box_may_count_for_two_classes() -> None:
    """As many anchors as rows: which of the axes is which cannot be told from their lengths."""
    raw = np.zeros((1, 6, 6), np.float32)
    raw[0, :, 2] = [1, 2, 11, 12, 0.4, 0.3]
    found = candidates(raw, True, 0.05)
    assert found.boxes.tolist() == [[1, 2, 11, 12]] * 2
    assert sorted(zip(found.numbers.tolist(), (10 * found.scores).round().tolist(), strict=True)) == [(0, 4), (1, 3)]


def test_nothing_certain_enough() -> None:
    found = candidates(np.zeros((3, 5, 7), np.float32), False, 0.0)
    assert found.boxes.shape == (0, 4)
    assert len(found.picture) == len(found.scores) == len(found.numbers) == 0


@pytest.mark.parametrize("end2end", [False, True])
def test_only_the_best_of_each_picture_are_kept(end2end: bool) -> None:
    rng = np.random.default_rng(0)
    raw = rng.random((3, 6, 500), np.float32)
    raw[1, 4:] *= rng.random(500) < 0.1  # one picture has few
    found = candidates(raw, end2end, 0.1)
    for picture in range(3):
        scores = raw[picture, 4:] if end2end else raw[picture, 4:].max(axis=0)
        best = np.sort(scores[scores > 0.1])[::-1][:MAX_CANDIDATES]
        np.testing.assert_array_equal(np.sort(found.scores[found.picture == picture])[::-1], best)
