"""`annotator classes` and `annotator import --add-attributes`: the classes and attributes of a project."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from annotator.project import NewLabel, WriteContext, create_project, open_project
from annotator.recordings import open_recording
from annotator.types import OrientedBox
from annotator.workflows.add_recordings import register_recording

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
        "order cars bus,auto",
    ):
        run(f"classes {words}")
    content = json.loads(run("classes list cars --json"))
    assert content["classes"] == [
        {"name": "bus", "labels": 0, "boxes_2d": 0, "said": 0, "colour": "#3366ff", "key": "b"},
        {"name": "auto", "labels": 1, "boxes_2d": 0, "said": 0, "colour": None, "key": "a"},
    ]
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
    assert "auto  1 label, 0 2D boxes, key a" in shown
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
