"""Training sets on disk, and which frames are in them; the perfect detector."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from annotator.detection.dataset import TrainingSample, read_manifest, tiled, write_dataset, yolo_line
from annotator.detection.perfect import PerfectDetector
from annotator.detection.yolo import GREY, Candidates, candidates, fill_batch, place, suppressed, to_pictures
from annotator.types import Box2D, Camera, Frame, OrientedBox, PointCloud, PseudoView, Region, Truth
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


CAMERA = Camera(200, 160, 150.0, 150.0, 99.5, 79.5)


def make_box(center: tuple[float, float, float], size: tuple[float, float, float], turn: float = 0.4) -> OrientedBox:
    return OrientedBox.from_parts(
        np.array(center), Rotation.from_euler("yx", [turn, 0.2]).as_matrix(), np.array(size, np.float64)
    )


def fill(box: OrientedBox, n: int, seed: int = 0) -> np.ndarray:
    """Points spread evenly inside a box."""
    local = np.random.default_rng(seed).uniform(-0.49, 0.49, (n, 3)) * box.size_m
    return (local @ box.rotation.T + box.center_m).astype(np.float32)


def make_frame(truths: list[Truth], counts: list[int], key: str = "000001", camera: Camera = CAMERA) -> Frame:
    xyz = np.concatenate([fill(t.box, n, i) for i, (t, n) in enumerate(zip(truths, counts, strict=True))])
    rgb = np.zeros((camera.height_px, camera.width_px, 3), np.uint8)
    return Frame(key, 0, camera, rgb, PointCloud(xyz))


def make_view(xyz: np.ndarray, size: tuple[int, int] = (120, 90), scale: float = 0.02) -> PseudoView:
    """A view along an oblique direction, centred on the points."""
    axes = Rotation.from_euler("zyx", [0.3, -0.5, 0.8]).as_matrix()
    middle = (xyz @ axes[:2].T).mean(axis=0)
    rgb = np.zeros((size[1], size[0], 3), np.uint8)
    return PseudoView(rgb, axes, scale, middle - (np.array(size) - 1) / 2 * scale, xyz)


NEAR = Truth("Car", make_box((0.0, 0.1, 3.0), (1.0, 0.6, 0.4)))
FAR = Truth("Van", make_box((1.0, -0.3, 5.0), (0.8, 0.8, 0.8), 1.1))


def test_view_box_spans_the_projected_corners() -> None:
    frame = make_frame([NEAR, FAR], [50, 30])
    view = make_view(frame.cloud.xyz_m, (300, 300), 0.02)
    car, van = PerfectDetector.for_frame(frame, [NEAR, FAR]).detect([view])[0]
    assert (car.label, van.label) == ("Car", "Van")  # most points first
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
    for box, truth in ((car, NEAR), (van, FAR)):
        corners = truth.box.T_camera_box.apply(signs * truth.box.size_m / 2)
        along = corners @ view.axes[:2].T
        np.testing.assert_allclose(
            view.interval_m(box), np.stack([along.min(axis=0), along.max(axis=0)], axis=1), atol=1e-9
        )


@pytest.mark.parametrize(("drawn", "found"), [(0, 0), (2, 0), (4, 0), (5, 1), (50, 1)])
def test_objects_with_too_few_drawn_points_are_not_detected(drawn: int, found: int) -> None:
    frame = make_frame([NEAR], [50])
    rest = np.array([[9.0, 9.0, 9.0]], np.float32)
    view = make_view(np.concatenate([frame.cloud.xyz_m[:drawn], rest]), (900, 900), 0.05)
    assert len(PerfectDetector.for_frame(frame, [NEAR]).detect([view])[0]) == found


def test_boxes_on_a_region_are_those_of_the_image_shifted_and_clipped() -> None:
    frame = make_frame([NEAR, FAR], [50, 50])
    detector = PerfectDetector.for_frame(frame, [NEAR, FAR])
    whole = {box.label: box for box in detector.detect([frame])[0]}
    near = whole["Car"]
    x, y = int(near.x_min) + 3, max(int(near.y_min) - 4, 0)
    region = Region(frame, x, y, 200 - x, 160 - y)
    (on_region,) = detector.detect([region])
    shown = {box.label: box for box in on_region}["Car"]
    assert shown.xyxy == (-0.5, near.y_min - y, near.x_max - x, near.y_max - y)
    corner = Region(frame, 0, 0, 2, 2)
    assert detector.detect([corner]) == [[]]
