"""3D boxes from 2D boxes of any origin: stored as proposals, with their origin, and no frame is lost."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from threading import Lock

import numpy as np
import pytest
from test_warm_start import AnyClass

from annotator.cli.main import main
from annotator.detection.pretrained import TITLE
from annotator.geometry.iou import iou_3d
from annotator.geometry.outline import box_on_image
from annotator.project import NewLabel, Project, WriteContext
from annotator.project.changes import FrameFinalised, ImageBoxesSet
from annotator.rcv.config import RcvConfig
from annotator.types import Box2D, BoxKind, OrientedBox, ReviewState, Source
from annotator.types.errors import ConfigError, FormatError
from annotator.workflows.detectors import Detectors, base_titles
from annotator.workflows.exporting import ExportFilter, ExportFormat, export_project
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing import FlatFormat, Note
from annotator.workflows.proposing.annotate import annotate
from annotator.workflows.proposing.lift import GivenBoxes, RenamedDetector, boxes_of_file, drawn_boxes, lift
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.settings import rcv_config
from annotator.workflows.workbench import loaded_detectors
from annotator.workflows.workbench.loaded_detectors import ReadyDetector


@pytest.fixture
def base(knowing: Callable[..., Detectors]) -> ReadyDetector:
    return ReadyDetector(AnyClass(knowing("people").view), BoxKind.BOX, Lock(), True, "base detector")


def outlines(project: Project, index: int) -> tuple[Box2D, ...]:
    """The outlines of a frame's true boxes."""
    source, stored = FrameSource(project), project.frames.of()[index]
    frame = source.read(stored)
    truths = load_truth(source.recording(stored.recording_id), index, frame)
    boxes = [box_on_image(frame.camera, truth.box, truth.label) for truth in truths]
    return tuple(box for box in boxes if box is not None)


def draw(project: Project, index: int) -> tuple[Box2D, ...]:
    """Draws the outlines of a frame's true boxes on its image."""
    stored, boxes = project.frames.of()[index], outlines(project, index)
    drawn = ImageBoxesSet(boxes=boxes, box_kind=BoxKind.BOX)
    project.log.append(stored.id, [drawn], WriteContext(stored.revision, "ann", Source.MANUAL))
    return boxes


def quick(project: Project) -> RcvConfig:
    """For tests in which the quality of proposals does not matter."""
    return rcv_config(project).model_copy(update={"max_steps": 1})


def test_drawn_boxes_become_proposals(people: Project, base: ReadyDetector) -> None:
    with pytest.raises(ConfigError, match="has no boxes on its images; give --boxes or --detector, or draw some"):
        drawn_boxes(people)
    stored, drawn = people.frames.of()[1], draw(people, 1)
    done = lift(people, drawn_boxes(people), base, rcv_config(people))
    labels = [stored.label for stored in people.labels.select()]
    assert (done.done, done.proposals, done.failures) == (1, len(drawn), 0)
    assert {label.state for label in labels} == {ReviewState.PROPOSED}
    assert {label.source for label in labels} == {Source.AUTO}
    frame = FrameSource(people).read(stored)
    truths = load_truth(FrameSource(people).recording(stored.recording_id), 1, frame)
    for truth in truths:
        assert max(iou_3d(truth.box, label.box) for label in labels) > 0.8
    run = people.jobs.all()[-1]
    assert json.loads(run.config)["lifted from"] == "boxes drawn on the images"
    assert run.view_detector == "any class"
    assert "image_box_kind" not in json.loads(run.config)


def test_boxes_of_a_coco_file_are_lifted_with_their_classes_mapped(
    people: Project, base: ReadyDetector, tmp_path: Path
) -> None:
    boxes = outlines(people, 0)
    camera = FrameSource(people).read(people.frames.of()[0]).camera
    content = {
        "images": [{"id": 1, "file_name": "000000.jpg", "width": camera.width_px, "height": camera.height_px}],
        "categories": [{"id": 1, "name": "human"}, {"id": 2, "name": "cat"}],
        "annotations": [
            {"id": i, "image_id": 1, "category_id": 1, "bbox": [b.x_min + 0.5, b.y_min + 0.5, b.width_px, b.height_px]}
            for i, b in enumerate(boxes)
        ]
        + [{"id": 99, "image_id": 1, "category_id": 2, "bbox": [5, 5, 20, 20]}],
    }
    file = tmp_path / "boxes.json"
    file.write_text(json.dumps(content))
    with pytest.raises(FormatError, match="has no box of the classes person, only cat, human; map its classes"):
        boxes_of_file(people, file, FlatFormat.COCO, None, {})
    given = boxes_of_file(people, file, FlatFormat.COCO, None, {"human": "person"})
    assert given.left_out.of(Note.OTHER_CLASS) == {"cat": 1}
    assert list(given.silhouettes) == [people.frames.of()[0].id]
    lift(people, given, base, quick(people))
    assert json.loads(people.jobs.all()[-1].config)["image_box_kind"] == BoxKind.SILHOUETTE
    given = boxes_of_file(people, file, FlatFormat.COCO, None, {"human": "person"}, BoxKind.BOX)
    done = lift(people, given, base, quick(people))
    assert (done.done, done.proposals) == (1, len(boxes))


def test_a_detector_of_any_origin_takes_the_place_of_the_image_detector(
    people: Project, base: ReadyDetector, knowing: Callable[..., Detectors]
) -> None:
    known = knowing("people").image
    image = RenamedDetector(known, ["human"], {"person": "human"})
    source = FrameSource(people)
    frames = [source.read(stored) for stored in people.frames.of()[:2]]
    assert image.labels == ("human",)
    for boxes, original in zip(image.detect(frames), known.detect(frames), strict=True):
        assert [replace(box, label="person") for box in boxes] == original
        assert {box.label for box in boxes} == {"human"}
    other = RenamedDetector(known, ["person"], {})
    assert image.fingerprint != other.fingerprint != known.fingerprint
    done = annotate(people, Detectors(other, base, base.box_kind, True), quick(people), limit=1)
    assert (done.done, done.failures) == (1, 0)
    assert done.proposals >= done.done
    with pytest.raises(ConfigError, match="the detector has none of the classes person, but hand"):
        RenamedDetector(knowing("hands").image, people.config.classes, {})


def test_a_view_detector_that_does_not_know_the_class_is_refused(
    people: Project, knowing: Callable[..., Detectors]
) -> None:
    hands = ReadyDetector(knowing("hands").view, BoxKind.BOX, Lock())
    stored = people.frames.of()[0]
    given = GivenBoxes("test", {stored.id: outlines(people, 0)}, {})
    with pytest.raises(ConfigError, match="the project's view detector was not trained on person"):
        lift(people, given, hands, quick(people))
    assert not people.jobs.all()


def test_labels_and_exports_name_the_base_detector(people: Project, base: ReadyDetector, tmp_path: Path) -> None:
    stored = people.frames.of()[1]
    lift(people, GivenBoxes("test", {stored.id: outlines(people, 1)}, {}), base, quick(people))
    (run,) = people.jobs.all()
    assert base_titles(people) == {run.id: TITLE}
    report = export_project(
        people, tmp_path / "out", ExportFormat.RCV, choose=ExportFilter(states=(ReviewState.PROPOSED,))
    )
    assert report.objects > 0
    manifest = json.loads((tmp_path / "out" / "dataset.json").read_text())
    named = {detector["role"]: detector["name"] for detector in manifest["detectors"]}
    assert named == {"image": "test", "view": TITLE}
    chosen = ExportFilter(states=(ReviewState.PROPOSED,))
    export_project(people, tmp_path / "openlabel", ExportFormat.OPENLABEL, choose=chosen)
    (document,) = (tmp_path / "openlabel").glob("*.json")
    comment = json.loads(document.read_text())["openlabel"]["metadata"]["comment"]
    assert comment == f"Detectors that proposed boxes: image: test; view: {TITLE}"


def test_only_frames_without_3d_boxes_are_lifted_if_asked(people: Project, base: ReadyDetector) -> None:
    first, second, third = people.frames.of()[:3]
    for index in (0, 1):
        draw(people, index)
    people.log.append(third.id, [ImageBoxesSet(boxes=(), box_kind=BoxKind.BOX)], WriteContext(third.revision, "ann"))
    assert people.boxes.frames_without_labels() == (first.id, second.id)
    box = OrientedBox.from_parts(np.array([0.0, 0.0, 3.0]), np.eye(3), np.ones(3))
    people.labels.create(first.id, [NewLabel("person", box)], WriteContext(people.frames.get(first.id).revision, "ann"))
    people.log.append(second.id, [FrameFinalised()], WriteContext(people.frames.get(second.id).revision, "ann"))
    assert people.boxes.frames_without_labels() == ()
    with pytest.raises(ConfigError, match="no frame has boxes on its image but no 3D box"):
        drawn_boxes(people, only_without_labels=True)


def test_the_command_lifts_drawn_boxes(
    people: Project, base: ReadyDetector, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("annotator.cli.annotate.require_view", lambda _: base)
    draw(people, 1)
    where = [people.path.name, "--projects", str(people.path.parent)]
    assert main(["lift", *where]) == 0
    output = capsys.readouterr().out
    assert f"3D boxes from boxes drawn on the images, measured by: {TITLE}\n1 frame done" in output
    assert main(["lift", *where, "--boxes", "x.json", "--detector", "x.pt"]) == 2
    assert "exclude each other" in capsys.readouterr().err
    assert main(["lift", *where, "--classes", "car"]) == 2
    assert "--classes car: write CLASS_OF_THE_FILE=CLASS_OF_THE_PROJECT" in capsys.readouterr().err
    assert loaded_detectors.ready_view(people) is None
