"""Cutting images into tiles where detection uses a larger scale than training."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from annotator.detection.dataset import TrainingSample, tiled
from annotator.types import Box2D

SIZE_PX = 64


def picture(height_px: int, width_px: int, box: Box2D | None = None) -> np.ndarray:
    """A grey image with a white object."""
    rgb = np.full((height_px, width_px, 3), 114, np.uint8)
    if box is not None:
        rgb[round(box.y_min + 0.5) : round(box.y_max + 0.5), round(box.x_min + 0.5) : round(box.x_max + 0.5)] = 255
    return rgb


def white(rgb: np.ndarray) -> tuple[float, ...]:
    """The box around the white pixels, from edge to edge."""
    rows, columns = np.nonzero(rgb.min(axis=2) > 200)
    return columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5


def test_images_with_the_scale_of_training_are_not_cut() -> None:
    samples = [TrainingSample(picture(40, 224), (), "g", "drawn", look_px=look) for look in (0, 32, SIZE_PX)]
    assert list(tiled(samples, SIZE_PX)) == samples


@settings(deadline=None, max_examples=60)
@given(st.integers(20, 224), st.integers(2, 60), st.integers(2, 60), st.data())
def test_a_tile_contains_its_object_at_the_scale_of_detection(
    height_px: int, across: int, along: int, data: st.DataObject
) -> None:
    along = min(along, height_px)
    x, y = data.draw(st.integers(0, 224 - across)), data.draw(st.integers(0, height_px - along))
    box = Box2D("a", x - 0.5, y - 0.5, x + across - 0.5, y + along - 0.5)
    sample = TrainingSample(picture(height_px, 224, box), (box,), "g", "drawn", ("uid",), look_px=224)
    around, anywhere = tiled([sample], SIZE_PX)
    assert around.load().shape == (min(height_px, SIZE_PX), SIZE_PX, 3)
    (shown,) = around.boxes
    assert shown.xyxy == white(around.load())
    assert (shown.x_max - shown.x_min, shown.y_max - shown.y_min) == (across, along)
    assert (around.label_uids, around.group, around.origin, around.look_px) == (("uid",), "g", "drawn", 0)
    assert anywhere.load().shape == around.load().shape
    for cut in anywhere.boxes:  # each labelled object has pixels in the tile, possibly cut off
        assert (cut.x_max - cut.x_min, cut.y_max - cut.y_min) == (across, along)
        low_x, low_y, high_x, high_y = white(anywhere.load())
        assert max(cut.x_min, -0.5) == low_x and min(cut.x_max, SIZE_PX - 0.5) == high_x
        assert max(cut.y_min, -0.5) == low_y and min(cut.y_max, anywhere.load().shape[0] - 0.5) == high_y


@settings(deadline=None, max_examples=200)
@given(st.floats(-0.5, 150), st.floats(-0.5, 30), st.floats(1, 70), st.floats(1, 70))
def test_objects_of_any_size_and_position_fit_into_their_tile(x: float, y: float, across: float, along: float) -> None:
    box = Box2D("a", x, y, min(x + across, 223.5), min(y + along, 79.5))
    around, _ = tiled([TrainingSample(picture(80, 224), (box,), "g", "drawn", look_px=224)], SIZE_PX)
    height, width = around.load().shape[:2]
    assert SIZE_PX <= width <= 1.15 * 71 + 1
    (shown,) = around.boxes
    assert shown.width_px == pytest.approx(box.width_px)
    assert -0.5 - 1e-9 <= shown.x_min < shown.x_max <= width - 0.5 + 1e-9
    assert -0.5 - 1e-9 <= shown.y_min < shown.y_max <= height - 0.5 + 1e-9


def test_boxes_scale_with_the_rounded_size_of_the_image() -> None:
    """61 rows become 53 rows, not 53.4."""
    box = Box2D("a", 99.5, 40.5, 119.5, 60.5)
    sample = TrainingSample(picture(61, 256, box), (box,), "g", "drawn", look_px=224)
    around = next(tiled([sample], SIZE_PX))
    assert around.load().shape[0] == 53
    assert around.boxes[0].y_max == pytest.approx(52.5)


def test_a_cut_neighbour_is_labelled_only_if_enough_is_visible() -> None:
    boxes = (Box2D("a", 100.0, 10.0, 110.0, 20.0), Box2D("b", 0.0, 0.0, 5.0, 5.0))
    sample = TrainingSample(picture(30, 224), boxes, "g", "drawn", ("first", "second"), look_px=224)
    first, second, _ = tiled([sample], SIZE_PX)
    assert ([box.label for box in first.boxes], first.label_uids) == (["a"], ("first",))
    assert ([box.label for box in second.boxes], second.label_uids) == (["b"], ("second",))
    some = TrainingSample(picture(30, 224), boxes, "g", "drawn", ("first",), look_px=224)
    assert [tile.label_uids for tile in tiled([some], SIZE_PX)][:2] == [("first",), ()]
