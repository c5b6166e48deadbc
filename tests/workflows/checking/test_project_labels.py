"""The check of a project's attributes: missing, not fitting, and contradicting values; statistics count them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from annotator.project import NewLabel, Project, WriteContext, create_project
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, AttributeKind, AttributeOf
from annotator.types import OrientedBox
from annotator.workflows.checking.project_labels import Kind, check, check_project


def put(project: Project, attribute: Attribute) -> None:
    project.change_classes(lambda config: edit.put_attribute(config, attribute), "ann")


def found(project: Project) -> list[tuple[str, str]]:
    warnings = check(project, lambda frame, boxes: None)
    return [(warning.key, warning.message) for warning in warnings if warning.kind is Kind.ATTRIBUTE]


def change_attribute(project: Project, name: str, /, **changed: object) -> None:
    """Changes an attribute as an editor of project.json would."""
    path = project.path / "project.json"
    config = json.loads(path.read_text())
    (attribute,) = (each for each in config["attributes"] if each["name"] == name)
    attribute.update(changed)
    path.write_text(json.dumps(config))


def test_missing_unfitting_and_contradicting_values_are_reported(tmp_path: Path) -> None:
    box = OrientedBox.from_parts(np.zeros(3), np.eye(3), np.ones(3))
    with create_project(tmp_path, "p", ["car"]) as project:
        project.recordings.add(tmp_path / "r", "rgbd", "r", ["a", "b", "c"], True)
        a, b, c = (frame.id for frame in project.frames.of())
        for frame in (a, b, c):
            project.labels.create(frame, [NewLabel("car", box, track_id=1)], WriteContext(0, "ann"))
        assert found(project) == []
        put(project, Attribute(name="colour", kind=AttributeKind.TEXT, of=AttributeOf.TRACK))
        put(project, Attribute(name="doors", kind=AttributeKind.INTEGER, required=True))
        put(project, Attribute(name="rain", kind=AttributeKind.BOOLEAN, of=AttributeOf.FRAME, required=True))
        uids = [project.labels.of_frame(frame)[0].uid for frame in (a, b, c)]
        missing = "this car has no value of doors, which is required"
        no_rain = "this frame has no value of rain, which is required"
        assert found(project) == [(key, line) for key in "abc" for line in (missing, no_rain)]
        for frame, uid in zip((a, b, c), uids, strict=True):
            project.labels.set_attributes(frame, uid, {"doors": 5}, WriteContext(1, "ann"))
            project.frames.set_attributes(frame, {"rain": True}, WriteContext(2, "ann"))
        project.labels.set_attributes(a, uids[0], {"colour": "red"}, WriteContext(3, "ann"))
        assert found(project) == []
        # one label of the track has another value, since it was in another track before
        project.labels.edit(c, uids[2], WriteContext(4, "ann"), label="car", box=box)
        project.labels.set_attributes(c, uids[2], {"colour": "blue"}, WriteContext(5, "ann"))
        path = project.path / "project.json"
        path.write_text(path.read_text().replace('"doors"', '"wheels"'))
        with project.store.write() as connection:
            connection.exec_driver_sql("UPDATE labels SET track_id = 1")
        lines = [line for key, line in found(project) if key == "c"]
        assert lines == [
            "this car has no value of wheels, which is required",
            "this car has the value doors = 5, but the project has no attribute doors for car",
            "colour of track 1 is mostly red, but blue here",
        ]
        assert project.statistics().attributes == {
            "colour": {"red": 2, "blue": 1},
            "doors": {"5": 3},
            "rain": {"true": 3},
            "wheels": {},
        }


def test_a_finalised_frame_without_boxes_needs_its_required_values(tmp_path: Path) -> None:
    with create_project(tmp_path, "p", ["car"]) as project:
        project.recordings.add(tmp_path / "r", "rgbd", "r", ["a", "b", "c"], True)
        put(project, Attribute(name="rain", kind=AttributeKind.BOOLEAN, of=AttributeOf.FRAME, required=True))
        a, b, _ = (frame.id for frame in project.frames.of())
        assert found(project) == []
        project.frames.set_attributes(a, {"rain": False}, WriteContext(0, "ann"))
        project.frames.finalise(a, WriteContext(1, "ann"))
        project.frames.finalise(b, WriteContext(0, "ann"))
        (warning,) = check_project(project).warnings
        assert (warning.key, warning.uid) == ("b", None)
        assert warning.message == "this frame has no value of rain, which is required"
        assert check_project(project, a).warnings == ()
        # a frame that its recording no longer has cannot be completed
        project.recordings.rescan(1, ["a", "c"])
        assert found(project) == []
        project.recordings.rescan(1, ["a", "b", "c"])
        change_attribute(project, "rain", default=True)
        assert found(project) == []
