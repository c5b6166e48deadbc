"""The commands of the loop, run in this process: output, results and errors."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from annotator.cli import annotate as annotate_command
from annotator.formats.coco import read_coco, write_coco
from annotator.formats.frame_names import PictureLabels
from annotator.formats.rcv import read_rcv
from annotator.project import WriteContext, open_project
from annotator.types import Box2D

Run = Callable[..., str]
Stats = Callable[[str], dict[str, Any]]


@pytest.fixture
def project(root: Path, made_rooms: Path) -> str:
    """A project of class person, with a recording but without its labels."""
    shutil.copytree(made_rooms / "plain", root)
    return "room"


def test_simulate_draws_silhouettes_by_default(project: str, run: Run, stats: Stats) -> None:
    said = run("simulate", project, "people", "--every", "2")
    assert "3 frames, 9 objects, 45 2D boxes drawn" in said
    assert stats("room")["labels"]["total"] == 0, "silhouettes by default"
    run("simulate", project, "people", "--box-kind", "box", "--every", "5")
    assert stats("room")["labels"]["total"] == 3


def test_written_views_can_be_imported(project: str, tmp_path: Path, run: Run, stats: Stats) -> None:
    boxes = (Box2D("person", 40.5, 40.5, 120.5, 200.5), Box2D("dog", 1.5, 1.5, 9.5, 9.5))
    write_coco(
        tmp_path / "c.json", [PictureLabels("000001.jpg", boxes, (320, 240)), PictureLabels("x.jpg", boxes, (320, 240))]
    )
    said = run("import", project, "c.json")
    assert "imported as 2D boxes: 1 person on 1 camera image" in said
    assert "skipped: 1 box of class dog, which is not in the project" in said
    assert "skipped: 1 image without a match in the project: x.jpg" in said

    said = run("views", project, "pictures")
    assert "2 pseudo-views in pictures" in said
    assert "annotator import room pictures/coco.json --pictures pictures" in said
    drawn = [
        PictureLabels(i.file_name, (Box2D("person", 10.5, 10.5, 60.5, 60.5),), i.size_px)
        for i in read_coco(tmp_path / "pictures" / "coco.json")
    ]
    write_coco(tmp_path / "pictures" / "coco.json", drawn)
    said = run("import", project, "pictures/coco.json", "--pictures", "pictures", "--box-kind", "box")
    assert "imported as 2D boxes: 2 person on 2 pseudo-views" in said
    counts = stats("room")
    assert (counts["image_boxes"]["boxes"], counts["view_boxes"]["boxes"]) == (1, 2)


def test_import_of_3d_boxes_as_2d(project: str, run: Run, stats: Stats) -> None:
    said = run("import", project, "--as", "2d", "--fraction", "0.2", "--seed", "1")
    counts = stats("room")
    on_views = counts["view_boxes"]
    assert said.startswith("1 of 5 labelled frames: 3 person on camera images; ")
    assert f" person on {on_views['pictures']} pseudo-views with {on_views['boxes']} boxes; " in said
    assert said.endswith("; 1 frame in total with 2D boxes made from 3D boxes\nnext: annotator train room\n")
    assert (counts["image_boxes"]["boxes"], counts["labels"]["total"]) == (3, 0)


def test_annotate_with_a_bad_frame_returns_1(
    root: Path,
    own_copy: Callable[[str], Path],
    knowing: Callable[..., object],
    run: Run,
    stats: Stats,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = own_copy("people")
    depth = folder / "depth" / "000002.png"
    depth.write_bytes(depth.read_bytes()[:700])
    monkeypatch.setattr(annotate_command, "trained_detectors", lambda *_: knowing("people"))
    run("new", "room", "--classes", "person")
    run("add", "room", folder, "--no-labels")
    said = run("annotate", "room", "--axes", "camera", code=1)
    assert "4 frames done" in said
    assert "1 failed" in said
    assert "  failed 000002: " in said
    assert "depth/000002.png" in said
    assert stats("room")["frames_failed"] == 1


def test_export_writes_a_dataset(root: Path, generated: Path, tmp_path: Path, run: Run) -> None:
    run("new", "room", "--classes", "person", "robot")
    run("add", "room", generated / "people")
    said = run("export", "room", "--format", "rcv", "out/3D_ROOM")
    assert "out/3D_ROOM: 5 frames, 15 person" in said
    assert len(read_rcv(tmp_path / "out" / "3D_ROOM")) == 5
    assert "exists and is not empty" in run("export", "room", "out/3D_ROOM", code=2)
    run("export", "room", "out/3D_ROOM", "--overwrite", "--images", "jpg", "--classes", "person")
    assert {path.suffix for path in (tmp_path / "out" / "3D_ROOM" / "images").iterdir()} == {".jpg"}
    said = run("export", "room", "out/states", "--states", "accepted", "--recordings", "people", "--empty-frames")
    assert "5 frames" in said


def test_whole_tracks_change_once_they_are_linked(root: Path, made_rooms: Path, run: Run) -> None:
    shutil.copytree(made_rooms / "labelled", root)
    with open_project(root / "room") as project:
        for frame in project.frames.of()[1:4]:
            for revision, label in enumerate(project.labels.of_frame(frame.id), frame.revision):
                project.labels.delete(frame.id, label.uid, WriteContext(revision, "ann"))
    assert "track 1: proposes 3 boxes" in run("tracks", "fill", "room", "people", "1")
    run(*["tracks", "fill", "room", "people", "2", "--from", "000000", "--to", "000004", "--refit"])
    assert "track 9 of people has no boxes" in run("tracks", "fill", "room", "people", "9", code=2)
    said = run("track", "room", "--recordings", "people")
    assert "12 boxes in 3 tracks of 1 recording, 0 changed" in said


CAR = "Car 0.00 0 0.10 100.00 120.00 190.00 180.00 1.50 1.60 4.00 2.00 1.60 20.00 0.20"
PNG = b"\x89PNG\r\n\x1a\n"


def test_kitti_curves_are_written_as_images(tmp_path: Path, run: Run) -> None:
    for name, score in (("found", " 0.5"), ("label_2", "")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "000000.txt").write_text(CAR + score)
    words = [tmp_path / "found", tmp_path / "label_2", "--protocol", "kitti", "--curves", tmp_path / "a" / "curves"]
    assert f"{tmp_path / 'a' / 'curves'}: 4 images" in run("evaluate", *words)
    files = sorted((tmp_path / "a" / "curves").iterdir())
    assert [file.name for file in files] == [f"Car_{metric}.png" for metric in ("3d", "aos", "bbox", "bev")]
    assert all(file.read_bytes().startswith(PNG) for file in files)
    assert list(json.loads(run("evaluate", *words, "--json"))) == ["Car"]


def test_a_project_instead_of_files(made_rooms: Path, tmp_path: Path, run: Run) -> None:
    root = ["--projects", str(shutil.copytree(made_rooms / "labelled", tmp_path / "projects"))]
    words = ["--project", "room", *root, "--protocol", "oriented"]
    found = json.loads(run("evaluate", *words, "--recordings", "people", "--json"))
    assert found["mAP"] == pytest.approx({"0.25": 1.0, "0.5": 1.0, "0.7": 1.0})
    assert found["classes"]["person"]["objects"] == 15
    assert "note: imported from the recordings themselves, and so compared with themselves: 15 of 15 labels" in run(
        "evaluate", *words
    )
    assert "no true box" in run("evaluate", *words, "--measured", "proposals", code=2)
    assert "measure proposals" in run("evaluate", *words, "--against", "reviewed", code=2)
