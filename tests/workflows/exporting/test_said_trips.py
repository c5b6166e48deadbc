"""Who said a box before its review goes with it into rcv and OpenLABEL and back; other formats report it as lost."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from annotator.formats.losses import Lost
from annotator.project import Project, WriteContext
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute
from annotator.types.errors import FormatError
from annotator.types.label import Said
from annotator.workflows.exporting import ExportFilter, ExportFormat, export_project
from annotator.workflows.importing import BoxFormat, Note, import_labels, import_proposals, read_labels

BOX = {"label": "person", "size": [0.5, 0.4, 1.8], "rotation": [[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]]}


def propose(project: Project, tmp_path: Path, source: str, **fields: Any) -> dict[str, int]:
    entry = BOX | {"center": [0.2, 0.1, 3.0]} | fields
    path = tmp_path / f"{source}.json"
    path.write_text(json.dumps({project.frames.of()[0].key: [entry]}))
    done = import_proposals(project, read_labels(BoxFormat.BOXES, path), source)
    return dict(done.of(Note.VALUE))


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


def same(a: Said, b: Said) -> bool:
    is_near = np.allclose(a.box.pose, b.box.pose, rtol=0, atol=1e-12)
    return is_near and [a.source, a.label, a.score, a.track_id, a.box_kind, list(a.box.size_m)] == [
        b.source, b.label, b.score, b.track_id, b.box_kind, list(b.box.size_m)
    ]  # fmt: skip


@pytest.mark.parametrize("format", [ExportFormat.RCV, ExportFormat.OPENLABEL])
def test_what_sources_said_survives_ten_trips(
    reviewed: Project, make_project: Callable[..., Project], generated: Path, tmp_path: Path, format: ExportFormat
) -> None:
    before, project = said_in(reviewed), reviewed
    assert [(each.source, each.score, each.track_id) for each in before] == [
        ("centerpoint v2", 0.9, 7),
        ("my own", 0.4, None),
    ]
    for trip in range(10):
        report = export_project(project, tmp_path / f"{trip}", format, choose=ExportFilter())
        assert Lost.SAID not in {each.kind for each in report.losses}
        project = make_project(generated / "people")
        import_labels(project, read_labels(BoxFormat(format), tmp_path / f"{trip}"))
        assert all(map(same, said_in(project), before)) and len(said_in(project)) == 2
    # it is part of the log
    project.log.rebuild()
    assert all(map(same, said_in(project), before))


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


@pytest.mark.parametrize("format", [each for each in ExportFormat if each not in ("rcv", "openlabel")])
def test_other_formats_report_it(reviewed: Project, tmp_path: Path, format: ExportFormat) -> None:
    report = export_project(reviewed, tmp_path / "out", format, choose=ExportFilter())
    assert [each.count for each in report.losses if each.kind is Lost.SAID] == [1]


def test_a_damaged_list_of_sources_is_refused_with_its_place(reviewed: Project, tmp_path: Path) -> None:
    export_project(reviewed, tmp_path / "out", ExportFormat.OPENLABEL, choose=ExportFilter())
    (file,) = (tmp_path / "out").glob("*.json")
    file.write_text(file.read_text().replace('\\"score\\":0.4', '\\"score\\":4'))
    with pytest.raises(FormatError, match=r"objects.*said_by\.1\.score: .*less than or equal to 1"):
        read_labels(BoxFormat.OPENLABEL, tmp_path / "out")


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
