"""Commands on classes and attributes, and those of the work: simulate, train, annotate, track, export."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from annotator.cli import annotate as annotate_command
from annotator.cli import tracks as tracks_command
from annotator.formats.coco import read_coco, write_coco
from annotator.formats.frame_names import PictureLabels
from annotator.formats.rcv import read_rcv
from annotator.project import NewLabel, StoredFrame, WriteContext, create_project, open_project
from annotator.recordings import open_recording
from annotator.types import Box2D, Frame, OrientedBox
from annotator.types.errors import DetectionError, FrameError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.frame_source import FrameSource

Run = Callable[..., str]


@pytest.fixture
def cars(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project with one label of the class car."""
    monkeypatch.setenv("ANNOTATOR_PROJECTS", str(tmp_path))
    box = OrientedBox.from_parts(np.zeros(3), np.eye(3), np.ones(3))
    with create_project(tmp_path, "cars", ["car", "van"]) as project:
        project.recordings.add(tmp_path / "r", "rgbd", "r", ["a"], True)
        project.labels.create(1, [NewLabel("car", box)], WriteContext(0, "ann"))
    return tmp_path / "cars"


def test_classes_and_attributes_are_changed_and_listed(cars: Path, run: Run) -> None:
    for words in (
        "add cars bus --colour 3366ff --key b",
        "attribute cars pose --kind choice --choices parked,driving --default parked --key p",
        "attribute cars pose --required --classes car,van",
        "rename cars car auto",
        "attribute cars age --kind integer",
        "order-attributes cars age,pose",
        "remove-attribute cars age",
        "rename-attribute cars pose=parked still",
        "merge cars van --into auto",
        "style cars auto --key a",
        "style cars auto --colour ff0000",
        "style cars auto --unset colour",
        "style cars auto --still",
        "order cars bus,auto",
    ):
        run(f"classes {words}")
    content = json.loads(run("classes list cars --json"))
    none = {"labels": 0, "boxes_2d": 0, "said": 0}
    assert content["classes"] == [
        none | {"name": "bus", "boxes": "no boxes", "colour": "#3366ff", "key": "b", "still": None},
        none | {"name": "auto", "boxes": "1 3D label", "labels": 1, "colour": None, "key": "a", "still": True},
    ]
    assert content["words"] == {"pose": "one of still, driving; of auto; required; default still; key p"}
    assert content["attributes"] == [
        {
            "name": "pose",
            "kind": "choice",
            "choices": ["still", "driving"],
            "classes": ["auto"],
            "required": True,
            "default": "still",
            "key": "p",
        }
    ]
    with open_project(cars) as project:
        (label,) = project.labels.of_frame(1)
        assert (label.label, label.attributes) == ("auto", {"pose": "still"})
    shown = run("classes list cars")
    assert "auto  1 3D label, key a" in shown
    assert "attribute pose: one of still, driving; of auto; required; default still; key p" in shown
    assert "removed pose and 1 value of it" in run("classes remove-attribute cars pose")
    assert "removed with the class: 1 label and 0 2D boxes of auto" in run("classes remove cars auto --with-boxes")
    for words, done in (
        ("", "undone: remove the class auto, by annotator classes"),
        ("", "undone: remove the attribute pose, by annotator classes"),
        ("--redo", "redone: remove the attribute pose, by annotator classes"),
    ):
        assert run(f"project undo cars {words}") == f"{done}\n"
    assert "nobody has nothing to undo" in run("project undo cars --author nobody", code=2)


REFUSED = [
    ("add cars car", "has the class 'car' already"),
    ("add cars bus --colour blue", "'#blue' is not a colour of six hexadecimal digits, such as #3366ff"),
    ("rename cars car van", "annotator classes merge cars car --into van"),
    ("remove cars car --into van --with-boxes", "give one of both"),
    ("order cars car", "must name each class once: car, van"),
    ("attribute cars pose", "a new attribute needs --kind"),
    ("attribute cars pose --kind integer --default red", "--default: pose must be a whole number"),
    ("attribute cars pose --default driving --unset default", "--default sets what --unset removes"),
]


def test_what_cannot_be_done_is_refused_with_the_way_out(cars: Path, run: Run) -> None:
    before = run("classes list cars --json")
    for words, problem in REFUSED:
        assert problem in run(f"classes {words}", code=2)
    assert run("classes list cars --json") == before


BOX = {"label": "person", "size": [0.5, 0.4, 1.8], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
VALUES: list[dict[str, Any]] = [
    {"pose": "sitting", "helmet": "true", "age": 7, "mass": 20, "remark": "first", "a b": 1, "plate": "0012"},
    {"pose": "standing", "helmet": False, "age": "8", "mass": 80.5, "remark": "second", "plate": "13"},
    {"pose": "sitting", "helmet": True, "age": 9.0, "mass": 70, "remark": "third", "mixed": True},
    {"pose": "standing", "mixed": 3, "plate": "1_4"},
]


@pytest.fixture
def folder(tmp_path: Path, generated: Path) -> Path:
    with create_project(tmp_path, "rooms", ("person",)) as project:
        register_recording(project, open_recording(generated / "people"))
        key = project.frames.of()[0].key
    place = {"center": [0, 0, 4.0], "score": 0.9}
    boxes = [BOX | place | {"center": [1.5 * n - 2, 0, 4.0], "attributes": each} for n, each in enumerate(VALUES)]
    boxes.append(BOX | place | {"score": 0.4})
    (tmp_path / "theirs.json").write_text(json.dumps({key: boxes}))
    return tmp_path


def test_attributes_of_a_file_are_added_with_the_kind_of_their_values(folder: Path, run: Run) -> None:
    words = f"import rooms {folder / 'theirs.json'} --as proposals --projects {folder}"
    out = run(f"{words} --source mine --min-score 0.5 --add-attributes")
    for line in (
        "proposed by mine: 4 person in 1 frame",
        "skipped: 1 box with a lower score",
        "added: attribute pose of a box: one of sitting, standing",
        "added: attribute helmet of a box: true or false",
        "added: attribute mass of a box: a number",
        "added: attribute remark of a box: a text of at most 1000 characters",
        "skipped: 1 value of attribute a b (not an attribute of the project)",
    ):
        assert line in out.splitlines()
    with open_project(folder / "rooms") as project:
        labels = [entry.label for entry in project.labels.select()]
        kinds = {each.name: each.kind.value for each in project.config.attributes}
    assert kinds == {
        "age": "number", "helmet": "boolean", "mass": "number", "mixed": "text", "plate": "text", "pose": "choice",
        "remark": "text",
    }  # fmt: skip
    assert dict(labels[1].attributes) == {
        "pose": "standing", "helmet": False, "age": 8.0, "mass": 80.5, "remark": "second", "plate": "13"
    }  # fmt: skip
    assert labels[2].attributes["mixed"] == "true"


def test_attributes_of_images_and_their_boxes_are_added_too(folder: Path, run: Run) -> None:
    words = f"--projects {folder}"
    run(f"import rooms {folder / 'theirs.json'} --add-attributes {words}")
    run(f"classes attribute rooms night --kind boolean --of frame {words}")
    with open_project(folder / "rooms") as project:
        frame = project.frames.of()[0]
        project.frames.set_attributes(frame.id, {"night": True}, WriteContext(frame.revision, "me"))
    run(f"export rooms {folder / 'out'} --format coco {words}")
    with open_project(folder / "rooms") as project:
        frames = project.frames.of()
        with project.store.write() as connection:
            connection.exec_driver_sql("UPDATE labels SET attributes = '{}'")
            connection.exec_driver_sql("UPDATE frames SET attributes = NULL")
            connection.exec_driver_sql("DELETE FROM attributes")
    out = run(f"import rooms {folder / 'out'} --add-attributes {words}")
    assert "added: attribute night of a frame: true or false" in out
    assert "attributes: 22 values for the 3D labels and frames that these images show" in out
    with open_project(folder / "rooms") as project:
        assert project.frames.attributes() == {frames[0].id: {"night": True}}


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


def test_whole_tracks_change_once_they_are_linked(
    root: Path, made_rooms: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(made_rooms / "labelled", root)
    with open_project(root / "room") as project:
        for frame in project.frames.of()[1:4]:
            for revision, label in enumerate(project.labels.of_frame(frame.id), frame.revision):
                project.labels.delete(frame.id, label.uid, WriteContext(revision, "ann"))
    assert "track 1: proposes 3 boxes" in run("tracks", "fill", "room", "people", "1")
    filling = ["tracks", "fill", "room", "people", "2", "--from", "000000", "--to", "000004", "--refit"]
    read = FrameSource.read

    def damaged(source: FrameSource, frame: StoredFrame) -> Frame:
        if frame.key == "000002":
            raise FrameError(Path("000002.png"), "is damaged")
        return read(source, frame)

    with monkeypatch.context() as at:
        at.setattr(tracks_command, "ready_view", Mock(side_effect=DetectionError("its file is broken")))
        assert "its file is broken" in run(*filling, code=2)
        at.setattr(tracks_command, "ready_view", lambda _: None)
        at.setattr(FrameSource, "read", damaged)
        said = run(*filling)
    assert "track 2: proposes 3 boxes" in said, "nothing was stored before"
    assert "not in frame 000002: 000002.png: is damaged" in said
    assert "track 9 of people has no boxes" in run("tracks", "fill", "room", "people", "9", code=2)
    said = run("track", "room", "--recordings", "people")
    assert "12 boxes in 3 tracks of 1 recording, 0 changed" in said


def test_a_track_is_said_to_stand_still_and_to_move(own_copy: Callable[[str], Path], root: Path, run: Run) -> None:
    people = own_copy("people")
    still = [f"{n:06},500000,4649776,0,0,0,0,1" for n in range(5)]
    (people / "poses.csv").write_text("\n".join(["key,x,y,z,qx,qy,qz,qw", *still]))
    run("new", "room", "--classes", "person")
    run("add", "room", people)
    run("classes style room person --still")
    assert "track 1 may stand still: person stands still" in run("tracks still room people")
    assert "(nothing was stored)" in run("tracks still room people 1 --dry-run")
    said = run("tracks still room people 1 --frame 000002")
    assert "track 1 (person) stands still, seen in" in said
    assert "proposes" in run("tracks moving room people 1 --frame 000002")
    assert "does not stand still" in run("tracks moving room people 1", code=2)


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
