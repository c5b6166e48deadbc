"""The commands of the loop, run in this process: output, results and errors."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from annotator.cli import annotate as annotate_command
from annotator.cli.main import main
from annotator.formats.coco import read_coco, write_coco
from annotator.formats.frame_names import PictureLabels
from annotator.formats.rcv import read_rcv
from annotator.project import WriteContext, open_project
from annotator.types import Box2D
from annotator.workflows.proposing.tasks import GivenDetectors

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of projects, set by the environment variable; commands run in its parent."""
    folder = tmp_path / "projects here"
    monkeypatch.setenv("ANNOTATOR_PROJECTS", str(folder))
    monkeypatch.chdir(tmp_path)
    return folder


@pytest.fixture
def project(root: Path, made_rooms: Path) -> str:
    """A project of class person, with a recording but without its labels."""
    shutil.copytree(made_rooms / "plain", root)
    return "room"


def run(capsys: Capture, *words: str, code: int = 0) -> str:
    """Runs a command and checks its exit code; returns its standard output, or standard error if it failed."""
    capsys.readouterr()
    assert main([str(word) for word in words]) == code
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err
    return captured.err if code == 2 else captured.out


def stats(capsys: Capture, name: str = "room") -> dict[str, object]:
    content: dict[str, object] = json.loads(run(capsys, "stats", name, "--json"))
    return content


def test_simulate_draws_silhouettes_by_default(project: str, capsys: Capture) -> None:
    said = run(capsys, "simulate", project, "people", "--every", "2")
    assert "3 frames, 9 objects, 45 2D boxes drawn" in said
    assert stats(capsys)["labels"]["total"] == 0, "silhouettes by default"
    run(capsys, "simulate", project, "people", "--box-kind", "box", "--every", "5")
    assert stats(capsys)["labels"]["total"] == 3


def test_written_views_can_be_imported(project: str, tmp_path: Path, capsys: Capture) -> None:
    boxes = (Box2D("person", 40.5, 40.5, 120.5, 200.5), Box2D("dog", 1.5, 1.5, 9.5, 9.5))
    write_coco(
        tmp_path / "c.json", [PictureLabels("000001.jpg", boxes, (320, 240)), PictureLabels("x.jpg", boxes, (320, 240))]
    )
    said = run(capsys, "import", project, "c.json")
    assert "imported as 2D boxes: 1 person on 1 camera image" in said
    assert "skipped: 1 box of class dog, which is not in the project" in said
    assert "skipped: 1 image without a match in the project: x.jpg" in said

    said = run(capsys, "views", project, "pictures")
    assert "2 pseudo-views in pictures" in said
    assert "annotator import room pictures/coco.json --pictures pictures" in said
    drawn = [
        PictureLabels(i.file_name, (Box2D("person", 10.5, 10.5, 60.5, 60.5),), i.size_px)
        for i in read_coco(tmp_path / "pictures" / "coco.json")
    ]
    write_coco(tmp_path / "pictures" / "coco.json", drawn)
    said = run(capsys, "import", project, "pictures/coco.json", "--pictures", "pictures", "--box-kind", "box")
    assert "imported as 2D boxes: 2 person on 2 pseudo-views" in said
    counts = stats(capsys)
    assert (counts["image_boxes"]["boxes"], counts["view_boxes"]["boxes"]) == (1, 2)


def test_import_of_3d_boxes_as_2d(project: str, capsys: Capture) -> None:
    said = run(capsys, "import", project, "--as", "2d", "--fraction", "0.2", "--seed", "1")
    counts = stats(capsys)
    on_views = counts["view_boxes"]
    assert said.startswith("1 of 5 labelled frames: 3 person on camera images; ")
    assert f" person on {on_views['pictures']} pseudo-views with {on_views['boxes']} boxes; " in said
    assert said.endswith("; 1 frame in total with 2D boxes made from 3D boxes\nnext: annotator train room\n")
    assert (counts["image_boxes"]["boxes"], counts["labels"]["total"]) == (3, 0)


def test_annotate_with_a_bad_frame_returns_1(
    root: Path,
    own_copy: Callable[[str], Path],
    knowing: Callable[..., object],
    capsys: Capture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = own_copy("people")
    depth = folder / "depth" / "000002.png"
    depth.write_bytes(depth.read_bytes()[:700])
    monkeypatch.setattr(annotate_command, "trained_detectors", lambda *_: GivenDetectors(knowing("people")))
    run(capsys, "new", "room", "--classes", "person")
    run(capsys, "add", "room", folder, "--no-labels")
    said = run(capsys, "annotate", "room", "--axes", "camera", code=1)
    assert "4 frames done" in said
    assert "1 failed" in said
    assert "  failed 000002: " in said
    assert "depth/000002.png" in said
    assert stats(capsys)["frames_failed"] == 1


def test_export_writes_a_dataset(root: Path, generated: Path, tmp_path: Path, capsys: Capture) -> None:
    run(capsys, "new", "room", "--classes", "person", "robot")
    run(capsys, "add", "room", generated / "people")
    said = run(capsys, "export", "room", "--format", "rcv", "out/3D_ROOM")
    assert "out/3D_ROOM: 5 frames, 15 person" in said
    assert len(read_rcv(tmp_path / "out" / "3D_ROOM")) == 5
    assert "exists and is not empty" in run(capsys, "export", "room", "out/3D_ROOM", code=2)
    run(capsys, "export", "room", "out/3D_ROOM", "--overwrite", "--images", "jpg", "--classes", "person")
    assert {path.suffix for path in (tmp_path / "out" / "3D_ROOM" / "images").iterdir()} == {".jpg"}
    said = run(
        capsys, "export", "room", "out/states", "--states", "accepted", "--recordings", "people", "--empty-frames"
    )
    assert "5 frames" in said


def test_interpolate_and_track(root: Path, made_rooms: Path, capsys: Capture) -> None:
    shutil.copytree(made_rooms / "labelled", root)
    with open_project(root / "room") as project:
        for frame in project.frames.of()[1:4]:
            for revision, label in enumerate(project.labels.of_frame(frame.id), frame.revision):
                project.labels.delete(frame.id, label.uid, WriteContext(revision, "ann"))
    assert "track 1: 3 frames filled" in run(capsys, "interpolate", "room", "people", "--track", "1")
    run(capsys, *["interpolate", "room", "people", "--track", "2", "--from", "000000", "--to", "000004", "--refit"])
    assert "track 9 has 0 reviewed boxes" in run(capsys, "interpolate", "room", "people", "--track", "9", code=2)
    said = run(capsys, "track", "room", "--recordings", "people")
    assert "12 boxes in 3 tracks of 1 recording, 0 changed" in said


HEAD = "image,class,cx,cy,cz,l,w,h,yaw"
CAR = "Car 0.00 0 0.10 100.00 120.00 190.00 180.00 1.50 1.60 4.00 2.00 1.60 20.00 0.20"
PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture
def rooms(tmp_path: Path) -> list[str]:
    (tmp_path / "truth.csv").write_text(f"{HEAD}\n1,night/stand,0,0,0,2,1.5,0.5,0.3\n")
    (tmp_path / "found.csv").write_text(f"{HEAD},score\n1,night/stand,0,0,0,2,1.5,0.5,0.3,0.9\n")
    return [str(tmp_path / "found.csv"), str(tmp_path / "truth.csv")]


def said(capsys: Capture, *words: object, code: int = 0) -> str:
    capsys.readouterr()
    assert main(["evaluate", *map(str, words)]) == code
    captured = capsys.readouterr()
    return captured.err if code else captured.out


def test_kitti_curves_are_written_as_images(tmp_path: Path, capsys: Capture) -> None:
    for name, score in (("found", " 0.5"), ("label_2", "")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "000000.txt").write_text(CAR + score)
    words = [tmp_path / "found", tmp_path / "label_2", "--protocol", "kitti", "--curves", tmp_path / "a" / "curves"]
    assert f"{tmp_path / 'a' / 'curves'}: 4 images" in said(capsys, *words)
    files = sorted((tmp_path / "a" / "curves").iterdir())
    assert [file.name for file in files] == [f"Car_{metric}.png" for metric in ("3d", "aos", "bbox", "bev")]
    assert all(file.read_bytes().startswith(PNG) for file in files)
    assert list(json.loads(said(capsys, *words, "--json"))) == ["Car"]


def test_a_project_instead_of_files(made_rooms: Path, tmp_path: Path, capsys: Capture) -> None:
    root = ["--projects", str(shutil.copytree(made_rooms / "labelled", tmp_path / "projects"))]
    words = ["--project", "room", *root, "--protocol", "oriented"]
    found = json.loads(said(capsys, *words, "--recordings", "people", "--json"))
    assert found["mAP"] == pytest.approx({"0.25": 1.0, "0.5": 1.0, "0.7": 1.0})
    assert found["classes"]["person"]["objects"] == 15
    assert "note: imported from the recordings themselves, and so compared with themselves: 15 of 15 labels" in said(
        capsys, *words
    )
    assert "no true box" in said(capsys, *words, "--measured", "proposals", code=2)
    assert "measure proposals" in said(capsys, *words, "--against", "reviewed", code=2)


def test_unusable_arguments_are_errors(rooms: list[str], tmp_path: Path, capsys: Capture) -> None:
    assert "give DETECTIONS and TRUTH" in said(capsys, rooms[0], "--protocol", "sunrgbd", code=2)
    assert "not both" in said(capsys, *rooms, "--protocol", "sunrgbd", "--project", "x", code=2)
    assert "need --project" in said(capsys, *rooms, "--protocol", "sunrgbd", "--measured", "proposals", code=2)
    assert "--relaxed is for the kitti protocol" in said(capsys, *rooms, "--protocol", "sunrgbd", "--relaxed", code=2)
    assert "no such folder" in said(capsys, tmp_path / "a", tmp_path / "b", "--protocol", "kitti", code=2)
    broken = said(capsys, rooms[1], rooms[1], "--protocol", "sunrgbd", code=2)
    assert f"{rooms[1]}:1: " in broken.replace("\n", "")
