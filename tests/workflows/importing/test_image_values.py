"""Attributes of 2D boxes in COCO files go to the 3D labels that the boxes show."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from annotator.project import NewLabel, Project, WriteContext, new_action
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute
from annotator.types import OrientedBox, ReviewState
from annotator.workflows.exporting import ExportFilter, ExportFormat, export_project
from annotator.workflows.importing import Importer, Note, import_image_boxes

SCHEMA: list[dict[str, Any]] = [
    {"name": "pose", "kind": "choice", "choices": ["sitting", "standing"]},
    {"name": "occluded", "kind": "boolean"},
    {"name": "night", "kind": "boolean", "of": "frame"},
]


@pytest.fixture
def project(make_project: Callable[..., Project], generated: Path) -> Project:
    """A project with two labels side by side; one has a value."""
    made = make_project(generated / "people")
    for fields in SCHEMA:
        made.change_classes(partial(edit.put_attribute, attribute=Attribute.model_validate(fields)), "ann")
    new = [NewLabel("person", box(-0.8), attributes={"pose": "sitting"}), NewLabel("person", box(0.8))]
    rejected = NewLabel("person", box(0.0), state=ReviewState.REJECTED)
    made.labels.create(made.frames.of()[0].id, [*new, rejected], WriteContext(0, "me"))
    return made


def box(x: float) -> OrientedBox:
    return OrientedBox.from_parts(np.array([x, 0.2, 3.0]), np.eye(3), np.array([0.5, 0.4, 1.0]))


def changed(project: Project, out: Path, change: Callable[[list[dict[str, Any]]], None]) -> Path:
    """An export whose annotations another tool has changed."""
    export_project(project, out, ExportFormat.COCO, choose=ExportFilter())
    (file,) = (out / "annotations").iterdir()
    content = json.loads(file.read_text())
    change(content["annotations"])
    file.write_text(json.dumps(content))
    return out


def values(project: Project) -> list[dict[str, Any]]:
    return [dict(each.attributes) for each in project.labels.of_frame(project.frames.of()[0].id)]


def test_labels_get_the_values_that_they_lack_and_the_rest_is_reported(project: Project, tmp_path: Path) -> None:
    def change(annotations: list[dict[str, Any]]) -> None:
        # as CVAT writes them: its own fields beside the task's attributes
        annotations[0]["attributes"] = {"pose": "standing", "occluded": True, "rotation": 0.0}
        annotations[1]["attributes"] = {"pose": "lying", "occluded": "false", "note": None}
        alone = annotations[1] | {"id": 9, "bbox": [0, 0, 5, 5], "attributes": ["crowded.no"]}
        annotations.append(alone)

    out = changed(project, tmp_path / "out", change)
    done = import_image_boxes(project, out, None, importer=Importer("ann", new_action()))
    assert values(project) == [{"pose": "sitting", "occluded": True}, {"occluded": False}, {}]
    assert (done[Note.SHOWN], done[Note.CONTRADICTED], done.boxes.total()) == (2, 1, 3)
    assert done.of(Note.VALUE) == {
        "rotation (not an attribute of the project)": 1,
        'pose must be one of sitting, standing, not "lying"': 1,
        "crowded (of 2D boxes without a 3D label)": 1,
    }
    # one action with the boxes
    project.history.undo("ann")
    assert values(project) == [{"pose": "sitting"}, {}, {}]
    assert project.boxes.on_image(project.frames.of()[0].id) is None


def test_a_drawn_box_has_the_values_of_its_label(project: Project, tmp_path: Path) -> None:
    """A box drawn on the image replaces the outline of its label, not its values."""
    out = changed(project, tmp_path / "out", lambda annotations: annotations.pop())
    import_image_boxes(project, out, None)
    frame = project.frames.of()[0]
    project.frames.set_attributes(frame.id, {"night": True}, WriteContext(project.frames.get(frame.id).revision, "me"))
    report = export_project(project, tmp_path / "again", ExportFormat.COCO, choose=ExportFilter())
    assert "attribute" not in {each.kind.value for each in report.losses}
    (file,) = (tmp_path / "again" / "annotations").iterdir()
    content = json.loads(file.read_text())
    assert [each.get("attributes") for each in content["annotations"]] == [{"pose": "sitting"}, None]
    assert [each.get("attributes") for each in content["images"]] == [{"night": True}]
    # an image of a finalised frame changes nothing
    project.frames.finalise(frame.id, WriteContext(project.frames.get(frame.id).revision, "me"))
    assert import_image_boxes(project, tmp_path / "again", None)[Note.SHOWN] == 0
