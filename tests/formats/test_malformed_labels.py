"""Damaged label files that were once found give an AnnotatorError that names the file; tests/damage searches on."""

from __future__ import annotations

import io
import json
import re
import struct
import tempfile
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from dataset_samples import make_box, make_item, make_label, write
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.box_csv import read_box_csv
from annotator.formats.boxes_json import read_boxes
from annotator.formats.coco import read_coco
from annotator.formats.kitti_objects import read_kitti_file
from annotator.formats.kitti_rows import read_object_labels, read_tracking_labels
from annotator.formats.rcv import read_rcv
from annotator.formats.reading import read_mask, text_files
from annotator.formats.sunrgbd import read_extracted_labels, read_scene_labels
from annotator.types import PointCloud
from annotator.types.errors import AnnotatorError, FormatError

CAR = "Car 0.25 2 -1.55 548.00 171.33 572.40 194.42 1.48 1.56 3.62 -2.72 0.82 48.22 -1.62"
T = RigidTransform.from_translation([0.1, 0.2, 0.3])
IDENTITY = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
BOXES = {"000": {"label": "hand", "center": [0.1, 0.2, 0.9], "size": [0.1, 0.2, 0.3], "rotation": IDENTITY, "track": 3}}
COCO = {
    "images": [{"id": 1, "file_name": "a.png", "width": 20, "height": 10}],
    "annotations": [{"id": 1, "image_id": 1, "category_id": 1, "bbox": [1.0, 2.0, 3.0, 4.0], "iscrowd": 0}],
    "categories": [{"id": 1, "name": "hand"}],
}
SCENE = {"objects": [{"name": "bed", "polygon": [{"X": [0, 1, 1, 0], "Z": [1, 1, 3, 3], "Ymin": 0.5, "Ymax": 1.5}]}]}


def png(width: int = 4, height: int = 3) -> bytes:
    return bytes(cv2.imencode(".png", np.ones((height, width), np.uint8))[1].tobytes())


def zipped(names: tuple[str, ...] = ("a.txt", "b/c.txt")) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in names:
            archive.writestr(name, CAR + "\n")
    return buffer.getvalue()


def rcv_files() -> dict[str, bytes]:
    """A dataset of one frame."""
    cloud = PointCloud(np.ones((3, 3), np.float32), np.ones((3, 3), np.uint8))
    item = make_item([make_label(make_box((0.1, 0.2, 0.9), (0, 0, 0)), score=0.5)], key="000")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        write("rcv", out, [replace(item, frame=replace(item.frame, cloud=cloud))], classes=("hand",))
        return {str(file.relative_to(out)): file.read_bytes() for file in out.rglob("*.*") if file.is_file()}


RCV = rcv_files()
RCV_LABELS = next(name for name in RCV if name.startswith("labels/"))


def read_dataset(path: Path) -> None:
    """Reads the whole dataset that contains the file."""
    dataset = read_rcv(path if (path / "dataset.json").is_file() else path.parent)
    for i in range(len(dataset)):
        dataset.named_labels(i)


Reader = Callable[[Path], object]
READERS: dict[str, tuple[str, bytes, Reader]] = {
    "kitti": ("000.txt", f"{CAR}\n{CAR}\n".encode(), lambda path: read_object_labels(path, T)),
    "kitti_tracking": ("l.txt", f"0 1 {CAR}\n1 1 {CAR}\n".encode(), lambda path: read_tracking_labels(path, T)),
    "kitti_results": ("000.txt", f"{CAR} 0.5\n".encode(), lambda path: read_kitti_file(path, scored=True)),
    "sunrgbd": (
        "000.txt",
        b"bed 1 2 30 40 0.1 0.2 0.3 0.5 1 0.4 0.6 0.8\n",
        lambda path: read_extracted_labels(path, T),
    ),
    "sunrgbd_scene": ("index.json", json.dumps(SCENE, indent=1).encode(), lambda path: read_scene_labels(path, T)),
    "coco": ("coco.json", json.dumps(COCO, indent=1).encode(), read_coco),
    "boxes_json": ("boxes.json", json.dumps(BOXES, indent=1).encode(), read_boxes),
    "box_csv": (
        "boxes.csv",
        b"image,class,cx,cy,cz,l,w,h,yaw,score\na,bed,1,2,3,4,5,6,0.5,0.9\n",
        lambda path: read_box_csv(path, scored=True),
    ),
    "archive": ("labels.zip", zipped(), lambda path: list(text_files(path))),
    "mask": ("000.png", png(), read_mask),
    **{f"rcv/{name}": (name, content, read_dataset) for name, content in RCV.items() if name != "README.md"},
}


def complaint(read: Reader, path: Path) -> str | None:
    """The message of the AnnotatorError that a reader raises, or None; other exceptions fail the test."""
    try:
        read(path)
    except AnnotatorError as error:
        message = str(error)
        assert path.name in message or path.parent.name in message, message
        message.encode()  # can be printed
        return message
    return None


def put(name: str, folder: Path, content: bytes) -> Path:
    """Writes the file of a reader with this content, beside what it needs; returns the reader's argument."""
    file = READERS[name][0]
    for other, kept in {**(RCV if name.startswith("rcv/") else {}), file: content}.items():
        (folder / other).parent.mkdir(parents=True, exist_ok=True)
        (folder / other).write_bytes(kept)
    return folder if name.startswith("rcv/") else folder / file


def png_header(width: int, height: int) -> bytes:
    """A PNG whose header states this size, without pixel data."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    size = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", size) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def bomb() -> bytes:
    """An archive of a few kilobytes that unpacks to 20 MiB, more than a label file may have."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.txt", b"\0" * (20 << 20))
    return buffer.getvalue()


def changed(content: object, value: object, *place: str | int) -> bytes:
    """A JSON file with one value replaced."""
    content = json.loads(json.dumps(content))
    inner: Any = content
    for part in place[:-1]:
        inner = inner[part]
    inner[place[-1]] = value
    return json.dumps(content).encode()


def rcv(value: object, *place: str | int, file: str = RCV_LABELS) -> bytes:
    return changed(json.loads(RCV[file]), value, *place)


LABELS = f"rcv/{RCV_LABELS}"
# Cases found by hand or by fuzzing, with the expected message. The first one crashed the program.
FOUND: list[tuple[str, bytes, str]] = [
    ("boxes_json", b'{"0": ' + b"9" * 5000 + b"}", "boxes.json: has a number that cannot be read"),
    ("boxes_json", b'{"a":' + b"[" * 200_000, "boxes.json: is nested too deeply"),
    ("boxes_json", changed(BOXES, "\ud800", "000", "label"), r"has an unpaired surrogate \('.ud800'\)"),
    ("boxes_json", changed(BOXES, 1e308, "000", "rotation", 0, 0), "000.0.rotation.0.0: Input should be less than"),
    ("sunrgbd_scene", changed(SCENE, 1e308, "objects", 0, "polygon", 0, "X", 0), r"objects\.0\.polygon\.0\.X\.0: "),
    ("kitti", CAR.replace("48.22", "1e300").encode(), r"000\.txt:1: a box must be within 1e\+09 m"),
    ("kitti", CAR.replace("48.22", "9" * 5000).encode(), r"000\.txt:1: '9{40}' is not a finite number"),
    ("mask", png_header(100_000, 100_000), "image of 100000 x 100000 pixels is too large"),
    ("archive", bomb(), r"labels\.zip/a\.txt: is longer than 16 MiB"),
    (LABELS, rcv("a\0b", "image"), "'a.x00b' leads out of the folder"),
    (LABELS, rcv("../../../etc/passwd", "cloud"), "'../../../etc/passwd' leads out of the folder"),
    (
        "rcv/dataset.json",
        rcv("../../x", "frames", 0, file="dataset.json"),
        "the id '../../x' is not a valid file name",
    ),
]


@pytest.mark.parametrize(("name", "content", "says"), FOUND, ids=[f"{n}-{i}" for i, (n, _, _) in enumerate(FOUND)])
def test_known_cases_are_errors_without_large_memory_use(name: str, content: bytes, says: str, tmp_path: Path) -> None:
    path = put(name, tmp_path / "data", content)
    tracemalloc.start()
    try:
        message = complaint(READERS[name][2], path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert message is not None and re.search(says, message), message
    assert peak < 64 << 20
    assert len(message) < 1000


def test_links_out_of_a_dataset_are_refused(tmp_path: Path) -> None:
    secret = tmp_path / "secret.json"
    secret.write_bytes(RCV[RCV_LABELS])
    put(LABELS, tmp_path / "data", RCV[RCV_LABELS])
    image = tmp_path / "data" / next(name for name in RCV if name.startswith("images/"))
    labels = tmp_path / "data" / RCV_LABELS
    for file, target, says in (
        (image, secret, "leads out of the folder"),
        (image, image.name, "leads out of the folder"),
        (labels, secret, "leads out of the folder"),
    ):
        kept = file.read_bytes()
        file.unlink()
        file.symlink_to(target)
        assert says in (complaint(read_dataset, tmp_path / "data") or "")
        file.unlink()
        file.write_bytes(kept)
    assert complaint(read_dataset, tmp_path / "data") is None


def test_boxes_out_of_range_after_the_transform_to_the_camera_are_errors(tmp_path: Path) -> None:
    turned = RigidTransform.from_rotation(Rotation.from_euler("z", 45, degrees=True))
    label, scene = tmp_path / "label.txt", tmp_path / "index.json"
    label.write_text("bed 1 2 30 40 1e9 1e9 0.3 0.5 1 0.4 0.6 0.8\n")
    polygon = {"X": [1e9 - 1, 1e9, 1e9, 1e9 - 1], "Z": [1e9 - 1, 1e9 - 1, 1e9, 1e9], "Ymin": 0.5, "Ymax": 1.5}
    scene.write_text(json.dumps({"objects": [{"name": "bed", "polygon": [polygon]}]}))
    for path, read in ((label, read_extracted_labels), (scene, read_scene_labels)):
        assert read(path, None)
        with pytest.raises(FormatError, match=r"bed: a box must be within 1e\+09 m") as caught:
            read(path, turned)
        assert caught.value.path == path


def test_long_files_are_not_read_to_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("annotator.formats.reading.MAX_BYTES", 1 << 20)
    with (tmp_path / "boxes.json").open("wb") as file:
        file.truncate(4 << 30)  # sparse
    with pytest.raises(FormatError, match="larger than 1 MiB"):
        read_boxes(tmp_path / "boxes.json")


def test_archives_with_hostile_names_write_nothing(tmp_path: Path) -> None:
    path = tmp_path / "in" / "labels.zip"
    path.parent.mkdir()
    path.write_bytes(zipped(("../../up.txt", "/etc/root.txt", "C:\\x\\windows.txt")))
    files = {key: file for key, file, _ in text_files(path)}
    assert sorted(tmp_path.rglob("*")) == [path.parent, path]
    assert set(files) == {"up", "root", r"C:\x\windows"}
    assert all(file.parent == path for file in files.values())
