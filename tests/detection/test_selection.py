"""From images to canvases, and from raw predictions to boxes: small examples, and property tests against loops."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from annotator.detection.yolo import GREY, Candidates, candidates, fill_batch, place, suppressed, to_pictures


@given(height=st.integers(40, 300), width=st.integers(40, 300), side=st.sampled_from([64, 96]), seed=st.integers(0, 99))
def test_boxes_on_the_canvas_map_back_to_the_image(height: int, width: int, side: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    rgb = np.full((height, width, 3), GREY, np.uint8)
    x_min, y_min = int(rng.integers(0, width // 2)), int(rng.integers(0, height // 2))
    x_max, y_max = int(rng.integers(x_min + 10, width + 1)), int(rng.integers(y_min + 10, height + 1))
    rgb[y_min:y_max, x_min:x_max] = 255
    placement = place((height, width), side, 32)
    bright = fill_batch([rgb], [placement])[0, :, :, 0].astype(float) - GREY
    # Moments of the canvas give centre and extent of the rectangle with subpixel accuracy.
    edges = []
    for axis in (0, 1):
        profile = bright.sum(axis=axis)
        profile /= profile.max()
        middle = (profile * (np.arange(len(profile)) + 0.5)).sum() / profile.sum()
        edges.append((middle - profile.sum() / 2, middle + profile.sum() / 2))
    box = np.array([[edges[0][0], edges[1][0], edges[0][1], edges[1][1]]])
    got = to_pictures(box, np.zeros(1, np.int64), [placement])[0]
    want = np.array([x_min, y_min, x_max, y_max]) - 0.5
    scale = max(height, width) / side
    np.testing.assert_allclose(got, want, atol=0.8 * max(scale, 1))


def test_centre_and_size_become_edges_and_the_best_class_counts() -> None:
    raw = np.zeros((2, 6, 4), np.float32)
    raw[0, :, 3] = [10, 20, 4, 6, 0.4, 0.3]
    raw[1, :, 0] = [5, 5, 2, 2, 0.2, 0.9]
    selected = candidates(raw, False, 0.05)
    assert selected.picture.tolist() == [0, 1]
    assert selected.boxes.tolist() == [[8, 17, 12, 23], [4, 4, 6, 6]]
    assert selected.numbers.tolist() == [0, 1]
    np.testing.assert_allclose(selected.scores, [0.4, 0.9])


@pytest.mark.parametrize("end2end", [False, True])
def test_spreads_go_with_their_boxes_and_are_no_classes(end2end: bool) -> None:
    raw = np.zeros((1, 10, 3), np.float32)
    raw[0, :6, 1] = [10, 20, 14, 26, 0.4, 0.3]
    raw[0, 6:, :] = [[7, 1, 8], [7, 2, 8], [7, 3, 8], [7, 4, 8]]
    selected = candidates(raw, end2end, 0.35, edge_spread=True)
    assert selected.numbers.tolist() == [0]
    assert selected.spreads is not None and selected.spreads.tolist() == [[1, 2, 3, 4]]
    assert candidates(raw[:, :6], end2end, 0.35).spreads is None


def test_of_overlapping_boxes_of_an_image_and_class_the_better_one_stays() -> None:
    box = np.array([[0, 0, 10, 10], [1, 0, 11, 10], [1, 0, 11, 10], [40, 0, 50, 10], [1, 0, 11, 10]], np.float32)
    scores = np.array([0.5, 0.9, 0.8, 0.95, 0.1], np.float32)
    found = Candidates(np.array([0, 0, 0, 0, 2]), box, scores, np.array([0, 0, 1, 0, 0]))
    assert suppressed(found, 0.6).tolist() == [3, 1, 2, 4]
    assert suppressed(found, 0.9).tolist() == [3, 1, 2, 0, 4]
    none = np.zeros(0, np.int64)
    assert suppressed(Candidates(none, box[:0], scores[:0], none), 0.6).tolist() == []
