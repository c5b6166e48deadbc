"""EXIF orientations: as OpenCV turns, for images, boxes and masks; and where nothing decides, a refusal."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from annotator.formats.table import FlatFormat
from annotator.image_bytes import as_stored, box_as_stored, orientation_of, turned, turned_size
from annotator.project import Project
from annotator.recordings import open_recording
from annotator.types import Box2D
from annotator.types.errors import FormatError, FrameError
from annotator.workflows.importing.boxes_2d import import_image_boxes
from annotator.workflows.recorded.reading import load_mask

WIDTH, HEIGHT = 48, 32
# A red rectangle, in the pixels as stored.
LEFT, TOP, RIGHT, BOTTOM = 8, 4, 24, 12
BOX = (LEFT - 0.5, TOP - 0.5, RIGHT - 0.5, BOTTOM - 0.5)
EVERY, TURNED = range(2, 9), range(5, 9)


def tiff(orientation: int, order: str) -> bytes:
    mark = b"II*\0" if order == "<" else b"MM\0*"
    # another tag first
    entries = struct.pack(order + "HHIHH", 0x0100, 3, 1, 7, 0) + struct.pack(
        order + "HHIHH", 0x0112, 3, 1, orientation, 0
    )
    return mark + struct.pack(order + "IH", 8, 2) + entries + bytes(4)


def tagged(picture: np.ndarray, orientation: int, suffix: str = ".jpg", order: str = ">") -> bytes:
    """The bytes of a picture (RGB) with an EXIF orientation."""
    data = cv2.imencode(suffix, picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
    exif = tiff(orientation, order)
    if suffix == ".jpg":
        return data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 8) + b"Exif\0\0" + exif + data[2:]
    chunk = b"eXIf" + exif
    # before or behind the pixels
    at = 33 if order == ">" else len(data) - 12
    return data[:at] + struct.pack(">I", len(exif)) + chunk + struct.pack(">I", zlib.crc32(chunk)) + data[at:]


def picture(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    rgb = np.full((height, width, 3), (30, 60, 90), np.uint8)
    rgb[TOP:BOTTOM, LEFT:RIGHT] = (230, 20, 20)
    return rgb


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("order", "<>")
def test_pictures_are_turned_as_opencv_turns_them(orientation: int, suffix: str, order: str):
    data = tagged(picture(), orientation, suffix, order)
    assert orientation_of(data) == orientation
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    stored, shown = (cv2.imdecode(np.frombuffer(data, np.uint8), each) for each in (flags, cv2.IMREAD_COLOR))
    np.testing.assert_array_equal(turned(stored, orientation), shown)
    np.testing.assert_array_equal(as_stored(shown, orientation), stored)
    assert turned_size(orientation, (WIDTH, HEIGHT)) == shown.shape[1::-1]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_boxes_are_turned_as_pictures(orientation: int):
    rows, columns = np.nonzero(turned(picture()[:, :, 0] > 200, orientation))
    shown = Box2D("a", columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5, 0.25)
    box = box_as_stored(shown, orientation, (WIDTH, HEIGHT))
    assert (box.xyxy, box.score) == (BOX, 0.25)


@given(st.binary(max_size=60), st.integers(0, 90))
def test_damaged_tags_are_none(noise: bytes, at: int):
    for suffix in (".jpg", ".png"):
        data = tagged(picture(), 6, suffix)
        assert orientation_of(data[:at]) in range(1, 9)
        assert orientation_of(data[:at] + noise + data[at + len(noise) :]) in range(1, 9)
        assert orientation_of(noise) == 1


def recording(folder: Path, orientation: int, size: tuple[int, int] = (WIDTH, HEIGHT), *, depth: bool = True) -> Path:
    """A recording whose camera has a size."""
    width, height = size
    folder.mkdir()
    camera = {"width": width, "height": height, "intrinsic_matrix": [40.0, 0, 0, 0, 40.0, 0, width / 2, height / 2, 1]}
    (folder / "camera_intrinsic.json").write_text(json.dumps(camera))
    for name in ("color", "depth" if depth else "points"):
        (folder / name).mkdir()
    (folder / "color" / "000000.jpg").write_bytes(tagged(picture(), orientation))
    if depth:
        millimetres = np.full((height, width), 2000, np.uint16)
        (folder / "depth" / "000000.png").write_bytes(cv2.imencode(".png", millimetres)[1].tobytes())
    else:
        np.save(folder / "points" / "000000.npy", np.random.default_rng(0).uniform((-1, -1, 3), (1, 1, 4), (99, 3)))
    return folder


def red_box(rgb: np.ndarray) -> tuple[float, ...]:
    rows, columns = np.nonzero((rgb[:, :, 0] > 140) & (rgb[:, :, 1] < 40))
    return columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5


@pytest.mark.parametrize("orientation", EVERY)
def test_an_image_with_depth_is_as_it_is_stored(tmp_path: Path, orientation: int):
    frame = open_recording(recording(tmp_path / "r", orientation)).frame(0)
    assert (red_box(frame.rgb), frame.exif_orientation) == (BOX, orientation)


@pytest.mark.parametrize("depth", [True, False])
@pytest.mark.parametrize("orientation", [6, 7])
def test_a_calibration_that_fits_only_the_turned_image_turns_it(tmp_path: Path, orientation: int, depth: bool):
    frame = open_recording(recording(tmp_path / "r", orientation, (HEIGHT, WIDTH), depth=depth)).frame(0)
    assert (frame.rgb.shape, frame.exif_orientation) == ((WIDTH, HEIGHT, 3), 1)
    assert red_box(as_stored(frame.rgb, orientation)) == BOX


@pytest.mark.parametrize("orientation", EVERY)
def test_a_calibration_without_depth_decides_by_its_size_or_not_at_all(tmp_path: Path, orientation: int):
    opened = open_recording(recording(tmp_path / "r", orientation, depth=False))
    if orientation in TURNED:
        assert red_box(opened.frame(0).rgb) == BOX
        return
    with pytest.raises(FrameError, match=rf"000000\.jpg: it has the EXIF orientation {orientation} \("):
        opened.frame(0)


def coco(folder: Path, box: tuple[float, ...], size: tuple[int, int]) -> Path:
    bbox = [box[0] + 0.5, box[1] + 0.5, box[2] - box[0], box[3] - box[1]]
    content = {
        "images": [{"id": 1, "file_name": "000000.jpg", "width": size[0], "height": size[1]}],
        "categories": [{"id": 1, "name": "red"}],
        "annotations": [{"id": 1, "image_id": 1, "category_id": 1, "bbox": bbox}],
    }
    folder.mkdir(exist_ok=True)
    (folder / "coco.json").write_text(json.dumps(content))
    return folder / "coco.json"


def yolo(folder: Path, box: tuple[float, ...], size: tuple[int, int], image: bytes | None) -> Path:
    for name in ("images", "labels"):
        (folder / name).mkdir(parents=True)
    (folder / "data.yaml").write_text("train: images\nval: images\nnames: [red]\n")
    x, y = (box[0] + box[2] + 1) / 2 / size[0], (box[1] + box[3] + 1) / 2 / size[1]
    shares = (x, y, (box[2] - box[0]) / size[0], (box[3] - box[1]) / size[1])
    (folder / "labels" / "000000.txt").write_text("0 " + " ".join(f"{share:.9f}" for share in shares))
    if image is not None:
        (folder / "images" / "000000.jpg").write_bytes(image)
    return folder


def imported(project: Project, path: Path, format: FlatFormat) -> tuple[float, ...]:
    import_image_boxes(project, path, None, format=format)
    return tuple(np.round(project.boxes.on_images()[0].boxes[0].xyxy, 4).tolist())


Make = Callable[..., Project]
SHOWN_BOX = {o: red_box(turned(picture(), o)) for o in EVERY}


@pytest.mark.parametrize("orientation", [6, 7])
@pytest.mark.parametrize("as_shown", [True, False])
def test_sizes_of_coco_decide(make_project: Make, tmp_path: Path, orientation: int, as_shown: bool):
    project = make_project(recording(tmp_path / "r", orientation), classes=("red",))
    box, size = (SHOWN_BOX[orientation], (HEIGHT, WIDTH)) if as_shown else (BOX, (WIDTH, HEIGHT))
    assert imported(project, coco(tmp_path / "d", box, size), FlatFormat.COCO) == BOX


@pytest.mark.parametrize(
    "name", ["C:\\data\\000000.jpg", "\\\\server\\data\\000000.jpg", "/data/000000.jpg", "images\\000000.jpg"]
)
def test_images_of_other_computers_are_matched_by_their_names(make_project: Make, tmp_path: Path, name: str):
    project = make_project(recording(tmp_path / "r", 1), classes=("red",))
    path = coco(tmp_path / "d", BOX, (WIDTH, HEIGHT))
    path.write_text(path.read_text().replace('"000000.jpg"', json.dumps(name)))
    assert imported(project, path, FlatFormat.COCO) == BOX


@pytest.mark.parametrize("orientation", [5, 8])
def test_a_labelled_copy_without_the_tag_decides(make_project: Make, tmp_path: Path, orientation: int):
    project = make_project(recording(tmp_path / "r", orientation), classes=("red",))
    plain = cv2.imencode(".jpg", turned(picture(), orientation)[..., ::-1])[1].tobytes()
    path = yolo(tmp_path / "d", SHOWN_BOX[orientation], (HEIGHT, WIDTH), plain)
    assert imported(project, path, FlatFormat.YOLO) == BOX


@pytest.mark.parametrize("orientation", [3, 6])
@pytest.mark.parametrize("with_image", [True, False])
def test_boxes_in_shares_are_refused(make_project: Make, tmp_path: Path, orientation: int, with_image: bool):
    project = make_project(recording(tmp_path / "r", orientation), classes=("red",))
    image = tagged(picture(), orientation) if with_image else None
    path = yolo(tmp_path / "d", BOX, (WIDTH, HEIGHT), image)
    with pytest.raises(FormatError, match=rf"000000\.\w+ has the EXIF orientation {orientation} \("):
        imported(project, path, FlatFormat.YOLO)
    if orientation == 3:  # sizes do not decide half turns
        with pytest.raises(FormatError, match=f"EXIF orientation {orientation}"):
            imported(project, coco(tmp_path / "c", BOX, (WIDTH, HEIGHT)), FlatFormat.COCO)
    assert project.boxes.on_images() == ()


@pytest.mark.parametrize("orientation", [3, 6])
def test_masks_follow_the_same_rule(tmp_path: Path, orientation: int):
    folder = recording(tmp_path / "r", orientation)
    (folder / "mask").mkdir()
    opened = open_recording(folder)
    stored = (picture()[:, :, 0] > 200).astype(np.uint8)
    for mask in (stored, turned(stored, orientation)):
        (folder / "mask" / "000000.png").write_bytes(cv2.imencode(".png", mask)[1].tobytes())
        if orientation in TURNED:
            np.testing.assert_array_equal(load_mask(opened, opened.frame(0)), stored)
        else:
            with pytest.raises(FormatError, match=f"EXIF orientation {orientation}"):
                load_mask(opened, opened.frame(0))
