"""Training sets on disk."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from annotator.detection.dataset import TrainingSample, read_manifest, tiled, write_dataset, yolo_line
from annotator.types import Box2D
from annotator.types.errors import ConfigError, DetectionError

BOX = Box2D("hand", 3.0, 4.0, 20.0, 15.0)


def picture(seed: int = 0, size: tuple[int, int] = (24, 32)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (*size, 3), dtype=np.uint8)


def sample(group: str, boxes: Sequence[Box2D] = (BOX,), seed: int = 0, origin: str = "drawn") -> TrainingSample:
    return TrainingSample(picture(seed), tuple(boxes), group, origin)


def test_yolo_coordinates_start_half_a_pixel_before_the_first_pixel_centre() -> None:
    assert yolo_line(Box2D("a", -0.5, -0.5, 31.5, 23.5), 32, 24, 3) == "3 0.5000000 0.5000000 1.0000000 1.0000000"
    assert yolo_line(Box2D("a", -0.5, -0.5, 7.5, 5.5), 32, 24, 0) == "0 0.1250000 0.1250000 0.2500000 0.2500000"


@settings(max_examples=15, deadline=None)
@given(
    groups=st.lists(st.sampled_from("abcdefghij"), min_size=1, max_size=30),
    held=st.sets(st.sampled_from("abcdefghij"), max_size=9),
    labelled=st.sets(st.sampled_from("abcdefghij")),
)
def test_held_out_views_only_validate(
    groups: list[str], held: set[str], labelled: set[str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("sets")
    small, box = np.zeros((8, 8, 3), np.uint8), Box2D("hand", 0.0, 0.0, 5.0, 5.0)
    samples = [TrainingSample(small, (box,) * (group in labelled), group, "drawn") for group in groups]
    if not (set(groups) & labelled) - held:
        with pytest.raises(DetectionError, match="label"):
            write_dataset(folder / "a", samples, ["hand"], held.__contains__)
        return
    manifest = write_dataset(folder / "a", samples, ["hand"], held.__contains__)
    assert {entry.group for entry in manifest.entries if entry.split == "val"} == set(groups) & held
    assert manifest.measured_on == ("val" if set(groups) & held & labelled else "train")


def test_an_existing_set_stays_until_the_new_one_is_complete(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    first = write_dataset(folder, [sample("1"), sample("2")], ["hand"])
    with pytest.raises(ConfigError):
        write_dataset(folder, [sample("1"), sample("2", (Box2D("arm", 0.0, 0.0, 5.0, 5.0),))], ["hand"])
    assert read_manifest(folder) == first
    second = write_dataset(folder, [sample("7")], ["hand"])
    assert read_manifest(folder) == second
    assert len(list(folder.rglob("*.png"))) == 1
    assert list(tmp_path.iterdir()) == [folder]


def test_a_folder_with_other_files_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("all of it")
    with pytest.raises(DetectionError, match="not a training set"):
        write_dataset(tmp_path, [sample("1")], ["hand"])
    assert (tmp_path / "thesis.txt").exists()


SIZE_PX = 64


def picture_with_box(height_px: int, width_px: int, box: Box2D | None = None) -> np.ndarray:
    """A grey image with a white object."""
    rgb = np.full((height_px, width_px, 3), 114, np.uint8)
    if box is not None:
        rgb[round(box.y_min + 0.5) : round(box.y_max + 0.5), round(box.x_min + 0.5) : round(box.x_max + 0.5)] = 255
    return rgb


def white(rgb: np.ndarray) -> tuple[float, ...]:
    """The box around the white pixels, from edge to edge."""
    rows, columns = np.nonzero(rgb.min(axis=2) > 200)
    return columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5


@settings(deadline=None)
@given(st.integers(20, 224), st.integers(2, 60), st.integers(2, 60), st.data())
def test_a_tile_contains_its_object_at_the_scale_of_detection(
    height_px: int, across: int, along: int, data: st.DataObject
) -> None:
    along = min(along, height_px)
    x, y = data.draw(st.integers(0, 224 - across)), data.draw(st.integers(0, height_px - along))
    box = Box2D("a", x - 0.5, y - 0.5, x + across - 0.5, y + along - 0.5)
    sample = TrainingSample(picture_with_box(height_px, 224, box), (box,), "g", "drawn", ("uid",), look_px=224)
    around, anywhere = tiled([sample], SIZE_PX)
    assert around.rgb.shape == (min(height_px, SIZE_PX), SIZE_PX, 3)
    (shown,) = around.boxes
    assert shown.xyxy == white(around.rgb)
    assert (shown.x_max - shown.x_min, shown.y_max - shown.y_min) == (across, along)
    assert (around.label_uids, around.group, around.origin, around.look_px) == (("uid",), "g", "drawn", 0)
    assert anywhere.rgb.shape == around.rgb.shape
    for cut in anywhere.boxes:  # each labelled object has pixels in the tile, possibly cut off
        assert (cut.x_max - cut.x_min, cut.y_max - cut.y_min) == (across, along)
        low_x, low_y, high_x, high_y = white(anywhere.rgb)
        assert max(cut.x_min, -0.5) == low_x and min(cut.x_max, SIZE_PX - 0.5) == high_x
        assert max(cut.y_min, -0.5) == low_y and min(cut.y_max, anywhere.rgb.shape[0] - 0.5) == high_y


def test_a_cut_neighbour_is_labelled_only_if_enough_is_visible() -> None:
    boxes = (Box2D("a", 100.0, 10.0, 110.0, 20.0), Box2D("b", 0.0, 0.0, 5.0, 5.0))
    sample = TrainingSample(picture_with_box(30, 224), boxes, "g", "drawn", ("first", "second"), look_px=224)
    first, second, _ = tiled([sample], SIZE_PX)
    assert ([box.label for box in first.boxes], first.label_uids) == (["a"], ("first",))
    assert ([box.label for box in second.boxes], second.label_uids) == (["b"], ("second",))
    some = TrainingSample(picture_with_box(30, 224), boxes, "g", "drawn", ("first",), look_px=224)
    assert [tile.label_uids for tile in tiled([some], SIZE_PX)][:2] == [("first",), ()]
