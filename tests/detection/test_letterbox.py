"""Scaling images to canvases, and boxes back to images."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from annotator.detection.yolo import GREY, SQUARE_UP_TO_PX, fill_batch, place, to_pictures


@given(height=st.integers(1, 700), width=st.integers(1, 700), side=st.sampled_from([64, 224, 320]))
def test_the_canvas_is_the_smallest_multiple_of_the_stride(height: int, width: int, side: int) -> None:
    placement = place((height, width), side, 32)
    assert max(placement.scaled_width_px, placement.scaled_height_px) == side
    for canvas, scaled, border in zip(
        placement.canvas, (placement.scaled_width_px, placement.scaled_height_px), placement.corner, strict=True
    ):
        assert canvas % 32 == 0
        assert canvas == side if side <= SQUARE_UP_TO_PX else 0 <= canvas - scaled < 32
        assert border == (canvas - scaled) // 2


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


def test_boxes_are_clipped_to_their_own_image() -> None:
    placements = [place((100, 50), 64, 32), place((30, 60), 64, 32)]
    boxes = np.array([[-9.0, -9, 900, 900], [-9, -9, 900, 900]])
    got = to_pictures(boxes, np.array([1, 0]), placements)
    assert got.tolist() == [[-0.5, -0.5, 59.5, 29.5], [-0.5, -0.5, 49.5, 99.5]]
