"""`annotator import --add-attributes` gives a project the attributes of a file."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from annotator.cli.main import main
from annotator.project import WriteContext, create_project, open_project
from annotator.recordings import open_recording
from annotator.workflows.add_recordings import register_recording

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
    boxes = [BOX | {"center": [1.5 * n - 2, 0, 4.0], "attributes": values} for n, values in enumerate(VALUES)]
    (tmp_path / "theirs.json").write_text(json.dumps({key: boxes}))
    return tmp_path


def test_attributes_of_a_file_are_added_with_the_kind_of_their_values(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["import", "rooms", str(folder / "theirs.json"), "--as", "proposals", "--projects", str(folder)]
    assert main([*words, "--add-attributes"]) == 0
    out = capsys.readouterr().out
    for line in (
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


def test_without_the_option_the_report_names_it(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["import", "rooms", str(folder / "theirs.json"), "--projects", str(folder)]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "skipped: 4 values of attribute pose (not an attribute of the project)" in out
    assert "`annotator import PROJECT PATH --add-attributes` gives it those of a file, and its labels" in out
    assert main([*words, "--as", "2d", "--add-attributes"]) == 2
    assert "--add-attributes is for labels and proposals" in capsys.readouterr().err


def test_labels_that_came_with_a_recording_get_the_values_too(
    tmp_path: Path, generated: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, words = tmp_path / "take", ["--projects", str(tmp_path)]
    shutil.copytree(generated / "people", folder)
    (file,) = folder.rglob("boxes.json")
    content = json.loads(file.read_text())
    for boxes in content.values():
        for number, box in enumerate(boxes):
            box["attributes"] = {"pose": "sitting" if number % 2 else "standing", "age": number}
    file.write_text(json.dumps(content))
    assert main(["new", "rooms", "--classes", "person", *words]) == 0
    assert main(["add", "rooms", str(folder), *words]) == 0
    assert "annotator import PROJECT PATH --add-attributes" in capsys.readouterr().out
    with open_project(tmp_path / "rooms") as project:
        finalised, *rest = project.frames.of()
        project.frames.finalise(finalised.id, WriteContext(finalised.revision, "me"))
        first = project.labels.of_frame(rest[0].id)[0]
        assert main(["classes", "attribute", "rooms", "age", "--kind", "integer", *words]) == 0
        revision = project.frames.get(rest[0].id).revision
        project.labels.set_attributes(rest[0].id, first.uid, {"age": 77}, WriteContext(revision, "me"))
    again = ["import", "rooms", str(file), *words]
    assert main(again) == 0
    assert "attributes:" not in capsys.readouterr().out
    assert main([*again, "--add-attributes"]) == 0
    boxes = sum(map(len, content.values())) - len(content[finalised.key])
    assert f"attributes: {2 * boxes - 1} values for labels and frames that had none" in capsys.readouterr().out
    with open_project(tmp_path / "rooms") as project:
        assert [dict(each.attributes) for each in project.labels.of_frame(finalised.id)] == [{}] * 3
        assert project.labels.get(first.uid).label.attributes == {"pose": "standing", "age": 77}
        for frame in rest[1:]:
            given = [box["attributes"] for box in content[frame.key]]
            assert [dict(each.attributes) for each in project.labels.of_frame(frame.id)] == given
    assert main([*again, "--add-attributes"]) == 0
    assert "attributes:" not in capsys.readouterr().out


def test_attributes_of_images_and_their_boxes_are_added_too(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--projects", str(folder)]
    assert main(["import", "rooms", str(folder / "theirs.json"), "--add-attributes", *words]) == 0
    assert main(["classes", "attribute", "rooms", "night", "--kind", "boolean", "--of", "frame", *words]) == 0
    with open_project(folder / "rooms") as project:
        frame = project.frames.of()[0]
        project.frames.set_attributes(frame.id, {"night": True}, WriteContext(frame.revision, "me"))
    assert main(["export", "rooms", str(folder / "out"), "--format", "coco", *words]) == 0
    with open_project(folder / "rooms") as project:
        frames = project.frames.of()
        with project.store.write() as connection:
            connection.exec_driver_sql("UPDATE labels SET attributes = '{}'")
            connection.exec_driver_sql("UPDATE frames SET attributes = NULL")
        content = json.loads((project.path / "project.json").read_text())
        del content["attributes"]
        (project.path / "project.json").write_text(json.dumps(content))
    capsys.readouterr()
    assert main(["import", "rooms", str(folder / "out"), "--add-attributes", *words]) == 0
    out = capsys.readouterr().out
    assert "added: attribute night of a frame: true or false" in out
    assert "attributes: 22 values for the 3D labels and frames that these images show" in out
    with open_project(folder / "rooms") as project:
        assert project.frames.attributes() == {frames[0].id: {"night": True}}
