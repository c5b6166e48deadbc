"""Attributes and sources of labels from one project into another: what the other one can hold of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from annotator.project import NewLabel, Project, WriteContext
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute
from annotator.types import OrientedBox
from annotator.types.label import Said
from annotator.workflows.exporting import ExportFilter, ExportFormat, export_project
from annotator.workflows.importing import BoxFormat, Note, import_labels, import_proposals, read_labels
from benchmarks.trips import trip

BOX = {"label": "person", "size": [0.5, 0.4, 1.8], "rotation": [[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]]}


def propose(project: Project, tmp_path: Path, source: str, **fields: Any) -> dict[str, int]:
    entry = BOX | {"center": [0.2, 0.1, 3.0]} | fields
    path = tmp_path / f"{source}.json"
    path.write_text(json.dumps({project.frames.of()[0].key: [entry]}))
    done = import_proposals(project, read_labels(BoxFormat.BOXES, path), source)
    return dict(done.of(Note.VALUE))


SCHEMA: list[dict[str, Any]] = [
    {"name": "truncation", "kind": "number", "minimum": 0, "maximum": 1},
    {"name": "occlusion", "kind": "integer", "minimum": 0, "maximum": 3},
    {"name": "visibility", "kind": "choice", "choices": ["v0-40", "v40-60", "v60-80", "v80-100"]},
    {"name": "pose", "kind": "choice", "choices": ["sitting", "standing up", "1.5"]},
    {"name": "helmet", "kind": "boolean"},
    {"name": "state", "kind": "text"},
    {"name": "mass", "kind": "number"},
    {"name": "number", "kind": "integer", "of": "track"},
    {"name": "weather", "kind": "text", "of": "frame"},
    {"name": "night", "kind": "boolean", "of": "frame"},
]
VALUES: list[dict[str, Any]] = [
    {"truncation": 0.25, "occlusion": 2, "visibility": "v60-80", "pose": "standing up", "helmet": True},
    {"truncation": 0.0, "occlusion": 3, "visibility": "v0-40", "pose": "1.5", "helmet": False, "state": "true"},
    {"truncation": 1.0, "occlusion": 0, "visibility": "v80-100", "mass": -81.125, "number": 2**53},
    {"state": 'a.b, ä: "c"\n', "occlusion": 1, "truncation": 0.5, "visibility": "v40-60", "mass": 7.0, "number": -3},
]


@pytest.fixture
def make(make_project: Callable[..., Project], generated: Path) -> Callable[[], Project]:
    """Makes a project with the schema; its labels and values are those of `fill`."""

    def made() -> Project:
        project = make_project(generated / "people")
        for fields in SCHEMA:
            project.change_classes(
                lambda config, fields=fields: edit.put_attribute(config, Attribute.model_validate(fields)), "ann"
            )
        return project

    return made


def fill(project: Project, frame: int, values: list[dict[str, Any]]) -> None:
    label = project.config.classes[0]
    boxes = [
        OrientedBox.from_parts(np.array([n - 1.5, 0.0, 4.0]), np.eye(3)[[0, 2, 1]] * [1, 1, -1], np.full(3, 0.4))
        for n in range(4)
    ]
    new = [NewLabel(label, box, attributes=each) for box, each in zip(boxes, values, strict=True)]
    project.labels.create(frame, new, WriteContext(0, "ann"))


def test_values_have_the_kinds_of_the_projects_attributes_again(make: Callable[[], Project], tmp_path: Path) -> None:
    """nuScenes has them as names, such as `pose.1.5`."""
    project = make()
    fill(project, project.frames.of()[0].id, VALUES)
    trip(project, tmp_path / "out", ExportFormat.NUSCENES)
    found = [dict(entry.label.attributes) for entry in project.labels.select()]
    assert found == VALUES
    kinds = ([{name: type(value) for name, value in each.items()} for each in values] for values in (found, VALUES))
    assert next(kinds) == next(kinds)


def test_values_that_the_project_cannot_hold_are_reported(make: Callable[[], Project], tmp_path: Path) -> None:
    project = make()
    frame = project.frames.of()[0].id
    fill(project, frame, VALUES)
    export_project(project, tmp_path / "out", ExportFormat.RCV, choose=ExportFilter())
    project.change_classes(lambda config: edit.remove_attribute(config, "helmet"), "ann")
    narrow = Attribute.model_validate(SCHEMA[1] | {"maximum": 2})
    project.change_classes(lambda config: edit.put_attribute(config, narrow, drop=True), "ann")
    with project.store.write() as connection:
        connection.exec_driver_sql("DELETE FROM labels")
    done = import_labels(project, read_labels(BoxFormat.RCV, tmp_path / "out"))
    assert done.of(Note.VALUE) == {
        "helmet (not an attribute of the project)": 2,
        "occlusion must be a whole number from 0 to 2, not 3": 1,
    }


@pytest.fixture
def reviewed(make_project: Callable[..., Project], generated: Path, tmp_path: Path) -> Project:
    """A project with one accepted box, which two detectors had proposed."""
    project = make_project(generated / "people")
    propose(project, tmp_path, "centerpoint v2", score=0.9, track=7)
    propose(project, tmp_path, "my own", score=0.4, center=[0.25, 0.1, 3.0])
    (entry,) = project.labels.select()
    frame = project.frames.get(entry.frame_id)
    project.labels.accept(frame.id, entry.label.uid, WriteContext(frame.revision, "me"))
    return project


def said_in(project: Project) -> list[Said]:
    (entry,) = project.labels.select()
    return [each.said() for each in entry.said]


def test_sources_keep_the_names_of_renamed_classes_and_nothing_of_unknown_ones(
    reviewed: Project, make_project: Callable[..., Project], generated: Path, tmp_path: Path
) -> None:
    export_project(reviewed, tmp_path / "out", ExportFormat.RCV, choose=ExportFilter())
    (file,) = (tmp_path / "out" / "labels").iterdir()
    content = json.loads(file.read_text())
    content["objects"][0]["said"][1]["label"] = "chair"
    file.write_text(json.dumps(content))
    project = make_project(generated / "people", classes=("human",))
    import_labels(project, read_labels(BoxFormat.RCV, tmp_path / "out"), names={"person": "human"})
    assert [(each.source, each.label) for each in said_in(project)] == [("centerpoint v2", "human")]


def test_imported_proposals_have_attributes_of_the_file_defaults_and_those_of_their_track(
    make_project: Callable[..., Project], generated: Path, tmp_path: Path
) -> None:
    project = make_project(generated / "people")
    for fields in (
        {"name": "pose", "kind": "choice", "choices": ["sitting", "standing"]},
        {"name": "helmet", "kind": "boolean", "default": False},
    ):
        project.change_classes(partial(edit.put_attribute, attribute=Attribute.model_validate(fields)), "ann")
    left_out = propose(project, tmp_path, "a", score=0.9, attributes={"pose": "sitting", "hat": 1})
    assert left_out == {"hat (not an attribute of the project)": 1}
    assert attributes(project) == {"pose": "sitting", "helmet": False}
    # values that were set stay when another source says something of the frame
    (entry,) = project.labels.select()
    revision = project.frames.get(entry.frame_id).revision
    project.labels.set_attributes(entry.frame_id, entry.label.uid, {"helmet": True}, WriteContext(revision, "me"))
    propose(project, tmp_path, "b", score=0.2)
    assert attributes(project) == {"pose": "sitting", "helmet": True}
    project.log.rebuild()
    assert attributes(project) == {"pose": "sitting", "helmet": True}


def attributes(project: Project) -> dict[str, Any]:
    (entry,) = project.labels.select()
    return dict(entry.label.attributes)
