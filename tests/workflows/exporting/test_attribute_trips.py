"""Attributes survive ten trips through every format that holds them; what a format cannot hold is reported."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from annotator.formats.losses import Lost
from annotator.project import NewLabel, Project, WriteContext
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute
from annotator.types import OrientedBox
from annotator.types.messages import amount
from annotator.workflows.exporting import ExportFilter, ExportFormat, export_project
from annotator.workflows.importing import BoxFormat, import_labels, read_labels
from benchmarks.trips import trip

TRIPS = 10
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
OF_FRAME = {"weather": "light rain", "night": False}
ROUNDED = "truncation, rounded"
ALL = {each["name"] for each in SCHEMA}
# Format, the attributes of boxes that it holds, whether it holds those of frames. KITTI tracking has a test of its own.
BOTH = {"truncation", "occlusion"}
HELD = [
    pytest.param(ExportFormat.RCV, ALL, True, id="rcv"),
    pytest.param(ExportFormat.OPENLABEL, ALL, True, id="openlabel"),
    pytest.param(ExportFormat.COCO, ALL, True, id="coco"),
    pytest.param(ExportFormat.NUSCENES, ALL, False, id="nuscenes"),
    pytest.param(ExportFormat.SUSTECHPOINTS, ALL, False, id="sustechpoints"),
    pytest.param(ExportFormat.KITTI, BOTH, False, id="kitti"),
    pytest.param(ExportFormat.SUNRGBD, set[str](), False, id="sunrgbd"),
    pytest.param(ExportFormat.LABELCLOUD, set[str](), False, id="labelcloud"),
    pytest.param(ExportFormat.YOLO, set[str](), False, id="yolo"),
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


def values(project: Project) -> list[dict[str, Any]]:
    return [dict(entry.label.attributes) for entry in project.labels.select()]


@pytest.mark.parametrize(("format", "held", "of_frames"), HELD)
def test_attributes_are_equal_after_ten_trips_or_reported(
    make: Callable[[], Project], tmp_path: Path, format: ExportFormat, held: set[str], of_frames: bool
) -> None:
    project = make()
    frame = project.frames.of()[0].id
    fill(project, frame, VALUES)
    project.frames.set_attributes(frame, OF_FRAME, WriteContext(len(VALUES), "ann"))
    kept = [{name: value for name, value in each.items() if name in held} for each in VALUES]
    lost = Counter(name for each in VALUES for name in each if name not in held)
    lost += Counter() if of_frames else Counter(list(OF_FRAME))
    if not held:
        report = export_project(project, tmp_path / "out", format, choose=ExportFilter())
        assert [each.message for each in report.losses if each.kind is Lost.ATTRIBUTE] == [message(lost)]
        return
    for number in range(TRIPS):
        losses = trip(project, tmp_path / f"{number}", format).losses
        reported = [each.message for each in losses if each.kind is Lost.ATTRIBUTE]
        assert reported == ([message(lost)] if number == 0 and lost else [])
        assert values(project) == kept
        assert [[type(value) for _, value in sorted(each.items())] for each in values(project)] == [
            [type(value) for _, value in sorted(each.items())] for each in kept
        ]
        assert project.frames.attributes() == ({frame: OF_FRAME} if of_frames else {})


def message(lost: Counter[str]) -> str:
    by_name = ", ".join(f"{number} {name}" for name, number in sorted(lost.items()))
    return f"{amount(lost.total(), 'attribute value')} cannot be stored in this format ({by_name})"


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
    assert done.values == {
        "helmet (not an attribute of the project)": 2,
        "occlusion must be a whole number from 0 to 2, not 3": 1,
    }


def test_kitti_rounds_a_truncation_and_says_so(make: Callable[[], Project], tmp_path: Path) -> None:
    project = make()
    fill(project, project.frames.of()[0].id, [{"truncation": 0.333}, {"truncation": 0.25, "occlusion": 3}, {}, {}])
    report = export_project(project, tmp_path / "out", ExportFormat.KITTI, choose=ExportFilter())
    assert [each.message for each in report.losses if each.kind is Lost.ATTRIBUTE] == [message(Counter({ROUNDED: 1}))]
    (rows,) = (tmp_path / "out" / "training" / "label_2").iterdir()
    # the operator's values, not the measured ones
    assert [row.split()[1:3] for row in rows.read_text().splitlines()][1] == ["0.25", "3"]
    assert rows.read_text().split()[1] == "0.33"


def test_kitti_tracking_has_levels_of_truncation_and_says_what_becomes_of_shares(
    make: Callable[[], Project], tmp_path: Path
) -> None:
    project = make()
    shares = [0.0, 0.5, 0.51, 0.91]
    given = [{"truncation": share, "occlusion": number, "helmet": True} for number, share in enumerate(shares)]
    fill(project, project.frames.of()[0].id, given)
    for number in range(2):
        report = trip(project, tmp_path / f"{number}", ExportFormat.KITTI_TRACKING)
        (file,) = (tmp_path / f"{number}" / "training" / "label_02").iterdir()
        rows = [row.split() for row in file.read_text().splitlines()]
        assert [row[4] for row in rows] == ["0", "1", "2", "3"]
        losses = [each.message for each in report.losses if each.kind is Lost.ATTRIBUTE]
        if number == 0:
            assert [row[3] for row in rows] == ["0", "0", "1", "2"]
            assert losses == [message(Counter({"helmet": 4, "truncation, as a level": 3}))]
            # of the levels, only 0 is a share
            assert values(project) == [
                {"truncation": 0.0, "occlusion": 0},
                {"truncation": 0.0, "occlusion": 1},
                {"occlusion": 2},
                {"occlusion": 3},
            ]
        else:
            assert losses == []
