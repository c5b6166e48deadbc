"""Projects in the Python API detect, store and export, with the same results as the commands."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import annotator
from annotator.types import BoxKind, DetectorKind
from annotator.types.errors import ArgumentError, NotFoundError, ProjectError
from annotator.workflows.detectors import Detectors
from annotator.workflows.importing import Note

Knowing = Callable[..., Detectors]


@pytest.fixture
def people(tmp_path: Path, generated: Path) -> Any:
    with annotator.create_project(tmp_path / "people", classes=["person"]) as project:
        project.add(generated / "people", labels=False)
        yield project


@pytest.fixture
def trained(people: annotator.Project, knowing: Knowing, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Registers two models that load as perfect detectors; returns the list of loaded weights files."""
    loaded: list[Path] = []

    def load(path: Path, *_: Any, **__: Any) -> Any:
        loaded.append(path)
        return knowing("people", BoxKind.SILHOUETTE).image

    monkeypatch.setattr("annotator.api.project.load_detector", load)
    for kind in DetectorKind:
        folder = people.stored.models_folder / kind.value
        folder.mkdir()
        (folder / "detector.pt").touch()
        people.stored.models.register(
            kind, folder / "detector.pt", labels=["person"], box_kind=BoxKind.SILHOUETTE, metrics={}, fingerprint=kind
        )
    return loaded


def test_detection_takes_the_projects_detectors_and_settings(
    people: annotator.Project, trained: list[Path], knowing: Knowing
) -> None:
    stored = people.frames()[:2]
    frames = [people.read(frame) for frame in stored]
    found = people.detect(frames)
    assert [path.parent.name for path in trained] == ["image", "view"]
    pair = knowing("people", BoxKind.SILHOUETTE)
    for frame, each, boxes in zip(frames, found, pair.image.detect(frames), strict=True):
        assert each.key == frame.key and {proposal.image_box for proposal in each.proposals} == set(boxes)
    # as in a batch run: orientation from gravity, the kind of boxes from the detectors
    people.annotate(image_detector=pair.image, view_detector=pair.view, limit=2)
    for frame, each in zip(stored, found, strict=True):
        labels = people.labels(frame)
        stored_boxes = sorted(label.box.center_m.tolist() for label in labels)
        assert stored_boxes == sorted(proposal.box.center_m.tolist() for proposal in each.proposals)
        assert {label.state for label in labels} == {annotator.ReviewState.PROPOSED}
    # loaded once
    assert len(people.detect(frames[0]).proposals) == len(found[0].proposals) > 0 and len(trained) == 2


def test_given_2d_boxes_need_no_image_detector(
    people: annotator.Project, trained: list[Path], knowing: Knowing
) -> None:
    frame = people.read(people.frames()[0])
    (boxes,) = knowing("people", BoxKind.SILHOUETTE).image.detect([frame])
    # a frustum may hold a second object: two 3D boxes from one 2D box
    assert {each.image_box for each in people.detect(frame, image_boxes=boxes[:1]).proposals} == set(boxes[:1])
    found = people.detect(frame, image_detector=lambda _: boxes[:2])
    assert {each.image_box for each in found.proposals} == set(boxes[:2])
    assert [path.parent.name for path in trained] == ["view"]


def test_stored_proposals_can_be_exported_evaluated_and_imported(
    people: annotator.Project, knowing: Knowing, tmp_path: Path
) -> None:
    pair = knowing("people")
    done = people.annotate(image_detector=pair.image, view_detector=pair.view)
    assert (done.done, done.failures, done.proposals) == (5, 0, 15)
    assert people.annotate(image_detector=pair.image, view_detector=pair.view).skipped == 5
    assert (people.name, people.classes, [r.name for r in people.recordings]) == ("people", ("person",), ["people"])
    assert len(people.frames("people")) == 5
    report = people.export(tmp_path / "out", "openlabel")
    assert (report.frames, report.objects) == (5, 15)
    row = people.evaluate().rows[0]
    assert row[:3] == ("person", 15, 15)
    with annotator.create_project(tmp_path / "other", classes=["person"]) as other:
        other.add(people.recordings[0].path, labels=False)
        taken = other.import_labels(people.export(tmp_path / "rcv", states=["proposed"]).out, "rcv")
        assert taken[Note.NOT_REVIEWED] == 15


def test_recordings_bring_their_labels(tmp_path: Path, generated: Path) -> None:
    with annotator.create_project(tmp_path / "hands", classes=["hand"], rotation="free") as project:
        project.add(generated / "hands", name="mine")
        assert {label.label for frame in project.frames("mine") for label in project.labels(frame)} == {"hand"}
        with pytest.raises(NotFoundError):
            project.frames("yours")
    with annotator.open_project(tmp_path / "hands") as again:
        assert len(again.frames()) == 5


def test_invalid_option_values_are_errors(people: annotator.Project, tmp_path: Path, knowing: Knowing) -> None:
    with pytest.raises(ArgumentError, match="format must be one of rcv"):
        people.export(tmp_path / "out", "pascal")
    with pytest.raises(ArgumentError, match="states must be from proposed"):
        people.export(tmp_path / "out", states=["good"])
    with pytest.raises(ArgumentError, match="fingerprint"):
        people._detector_source(lambda frame: [], knowing("people").view, None)
    with pytest.raises(ProjectError):
        annotator.open_project(tmp_path / "nowhere")
