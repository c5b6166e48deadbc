"""Label files that were made to do harm: links and names that lead out, endless files and archives, boxes out of range.

tests/damage damages the files of every format.
"""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest
from dataset_samples import make_item, make_label, write
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.box_files import read_boxes
from annotator.formats.rcv import read_rcv
from annotator.formats.reading import text_files
from annotator.formats.sunrgbd import read_extracted_labels, read_scene_labels
from annotator.types.errors import FormatError


def zipped(path: Path, *names: str, content: bytes = b"Car\n") -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in names:
            archive.writestr(name, content)
    return path


def test_links_out_of_a_dataset_are_refused(tmp_path: Path) -> None:
    out, secret = tmp_path / "data", tmp_path / "secret.json"
    write("rcv", out, [make_item([make_label()])])
    image, labels = (next((out / name).iterdir()) for name in ("images", "labels"))
    secret.write_bytes(labels.read_bytes())
    for file, target in ((image, secret), (image, Path(image.name)), (labels, secret)):
        kept = file.read_bytes()
        file.unlink()
        file.symlink_to(target)
        with pytest.raises(FormatError, match="leads out of the folder"):
            read_rcv(out).labelled(0)
        file.unlink()
        file.write_bytes(kept)
    assert len(read_rcv(out).labelled(0)[1].truths) == 1


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


def test_long_files_are_not_read_to_the_end(tmp_path: Path) -> None:
    with (tmp_path / "boxes.json").open("wb") as file:
        file.truncate(4 << 30)  # sparse
    with pytest.raises(FormatError, match=r"larger than \d+ MiB"):
        read_boxes(tmp_path / "boxes.json")
    # a few kilobytes that unpack to 20 MiB
    with pytest.raises(FormatError, match=r"labels\.zip/a\.txt: is longer than 16 MiB"):
        list(text_files(zipped(tmp_path / "labels.zip", "a.txt", content=b"\0" * (20 << 20))))


def test_archives_with_hostile_names_write_nothing(tmp_path: Path) -> None:
    path = zipped(tmp_path / "labels.zip", "../../up.txt", "/etc/root.txt", "C:\\x\\windows.txt")
    files = {key: file for key, file, _ in text_files(path)}
    assert sorted(tmp_path.rglob("*")) == [path]
    assert set(files) == {"up", "root", r"C:\x\windows"}
    assert all(file.parent == path for file in files.values())
