"""The batch stores proposals, keeps errors to their frames and goes on; 3D boxes from 2D boxes of any origin."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from test_warm_start import AnyClass

from annotator.cli.main import main
from annotator.detection.pretrained import TITLE
from annotator.geometry.iou import iou_3d, iou_3d_matrix
from annotator.geometry.outline import box_on_image
from annotator.project import BoxRotation, NewLabel, Project, Status, WriteContext
from annotator.project.changes import FrameFinalised, ImageBoxesSet
from annotator.project.proposals import Proposals, Replaced
from annotator.rcv.config import RcvConfig
from annotator.recordings import open_recording
from annotator.types import (
    NO_CORRECTION,
    Box2D,
    BoxKind,
    Correction,
    Frame,
    Image,
    OrientedBox,
    Proposal,
    ReviewState,
    Source,
)
from annotator.types.errors import ConfigError, FormatError, HistoryError, ProjectError
from annotator.workflows.detectors import Detectors, base_titles
from annotator.workflows.exporting import ExportFilter, ExportFormat, export_project
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing import FlatFormat, Note
from annotator.workflows.proposing.annotate import TASK_FRAMES, WRITE_ATTEMPTS, annotate, annotate_with
from annotator.workflows.proposing.lift import GivenBoxes, RenamedDetector, boxes_of_file, drawn_boxes, lift
from annotator.workflows.proposing.runner import InlineEngine
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.settings import rcv_config
from annotator.workflows.workbench import loaded_detectors
from annotator.workflows.workbench.loaded_detectors import ReadyDetector

CONFIG = RcvConfig()
# For tests in which the quality of proposals does not matter.
FAST = RcvConfig(max_steps=1)
Knowing = Callable[..., Detectors]


class Wrapped:
    """Forwards to another detector; calls `act` while the frame `key` is being processed."""

    def __init__(
        self, inner: Detectors, fingerprint: str = "", *, key: str = "", act: Callable[[], object] = lambda: None
    ) -> None:
        self.inner, self.labels = inner.image, inner.image.labels
        self.fingerprint = fingerprint or self.inner.fingerprint
        self.key, self.act = key, act

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        for image in images:
            assert isinstance(image, Frame)
            if image.key == self.key:
                self.act()
        return self.inner.detect(images)

    def pair(self, views: Detectors) -> Detectors:
        return Detectors(self, views.view, views.box_kind)


def keys(project: Project, status: Status) -> list[str]:
    return sorted(project.frames.get(result.frame_id).key for result in project.jobs.results(status=status))


def only_reason(project: Project) -> str:
    (failure,) = project.jobs.results(status=Status.FAILED)
    assert failure.reason is not None
    return failure.reason


def bump(project: Project, index: int) -> None:
    """An operator changes something on a frame."""
    stored = project.frames.of()[index]
    project.boxes.set_on_image(stored.id, [], BoxKind.BOX, WriteContext(project.frames.get(stored.id).revision, "me"))


@pytest.mark.parametrize("kind", BoxKind)
def test_proposals_enclose_what_the_view_detector_measures(people: Project, knowing: Knowing, kind: BoxKind) -> None:
    annotate(people, knowing("people", kind), FAST, limit=1)
    stored = people.labels.select()
    assert stored and {one.label.box_kind for one in stored} == {kind}


def test_stored_proposals_match_the_true_boxes(people: Project, knowing: Knowing) -> None:
    told: list[tuple[int, int]] = []
    done = annotate(people, knowing("people"), CONFIG, progress=lambda k, n: told.append((k, n)))
    assert (done.frames, done.done, done.skipped, done.failed, done.without) == (5, 5, 0, [], 0)
    assert told == [(TASK_FRAMES, 5), (5, 5)]
    assert done.seconds > 0
    recording = open_recording(people.recordings.all()[0].path)
    total = 0
    for index, stored in enumerate(people.frames.of()):
        labels = people.labels.of_frame(stored.id)
        total += len(labels)
        assert {(label.state, label.source, label.author) for label in labels} == {
            (ReviewState.PROPOSED, Source.AUTO, "rcv")
        }
        truths = load_truth(recording, index, recording.frame(index))
        ious = iou_3d_matrix([truth.box for truth in truths], [label.box for label in labels]).max(axis=1)
        assert ious.min() > 0.9
    assert done.proposals == total == people.statistics().labels.total
    (run,) = people.jobs.all()
    assert run.finished_ns is not None
    assert keys(people, Status.DONE) == [f"{n:06d}" for n in range(5)]


@pytest.mark.parametrize(
    "change",
    [
        {"config": CONFIG.model_copy(update={"max_steps": 2})},
        {"rotation": BoxRotation.FREE},
        {"fingerprint": "other weights"},
    ],
    ids=["settings", "rotation", "detector"],
)
def test_other_settings_or_detectors_process_all_frames_again(
    people: Project, knowing: Knowing, change: dict[str, object]
) -> None:
    annotate(people, knowing("people"), FAST, limit=2)
    options = {"config": FAST, "rotation": None, "fingerprint": "", **change}
    detectors = Wrapped(knowing("people"), options["fingerprint"]).pair(knowing("people"))
    engine = InlineEngine(detectors)
    again = annotate_with(people, engine, options["config"], rotation=options["rotation"], limit=2)
    assert (again.done, again.skipped) == (2, 0)
    first = people.frames.of()[0]
    assert len(people.labels.of_frame(first.id)) == 3, "new proposals in place of the old ones"


def test_a_batch_is_one_action_of_who_started_it(people: Project, knowing: Knowing) -> None:
    def batch(config: RcvConfig, limit: int) -> tuple[int, int]:
        engine = InlineEngine(knowing("people"))
        done = annotate_with(people, engine, config, limit=limit, author="ann")
        return done.done, done.skipped

    def proposals() -> set[tuple[int, str]]:
        return {(stored.frame_id, stored.label.uid) for stored in people.labels.select()}

    other = FAST.model_copy(update={"max_steps": 2})
    assert batch(FAST, 2) == (2, 0)
    first = proposals()
    assert batch(other, 3) == (3, 0)
    second = proposals()
    assert people.history.undo("ann").words == "propose boxes (frames 1 to 3)"
    assert proposals() == first
    # what the frames were processed with comes back, too
    assert {frame.key for frame in people.jobs.pending(people.jobs.all()[0].key)} == {"000002", "000003", "000004"}
    people.history.redo("ann")
    assert proposals() == second
    assert batch(other, 1) == (1, 3)


def test_a_batch_that_is_undone_meanwhile_ends(people: Project, knowing: Knowing) -> None:
    inner = knowing("people")
    detectors = Wrapped(inner, key="000004", act=lambda: people.history.undo("rcv")).pair(inner)
    with pytest.raises(HistoryError, match="it was undone while it was running"):
        annotate(people, detectors, FAST)
    assert (people.labels.select(), len(people.jobs.results())) == ((), TASK_FRAMES)


def test_the_rotation_is_the_projects_unless_given(hands: Project, knowing: Knowing) -> None:
    up = open_recording(hands.recordings.all()[0].path).frame(0).up
    level = {}
    for rotation in (None, BoxRotation.UPRIGHT):  # the project's own setting is free
        engine = InlineEngine(knowing("hands"))
        annotate_with(hands, engine, CONFIG, rotation=rotation, limit=1)
        boxes = [label.box for label in hands.labels.of_frame(hands.frames.of()[0].id)]
        assert boxes
        level[rotation] = all(np.abs(box.rotation.T @ up).max() > 1 - 1e-6 for box in boxes)
    assert level == {None: False, BoxRotation.UPRIGHT: True}


def test_a_broken_frame_is_stored_with_its_reason_and_the_others_are_processed(
    copied: tuple[Path, Project], knowing: Knowing
) -> None:
    folder, project = copied
    depth = folder / "depth" / "000001.png"
    whole = depth.read_bytes()
    depth.write_bytes(whole[: len(whole) // 2])
    done = annotate(project, knowing("people"), FAST)
    assert (done.frames, done.done) == (5, 4)
    ((key, reason),) = done.failed
    assert key == "000001"
    assert "depth/000001.png" in reason
    assert only_reason(project) == reason
    assert project.statistics().frames_failed == 1
    # after the repair, only this frame is processed
    depth.write_bytes(whole)
    again = annotate(project, knowing("people"), FAST)
    assert (again.frames, again.done, again.skipped, again.failed) == (1, 1, 4, [])
    assert project.statistics().frames_failed == 0


def test_an_unexpected_error_affects_only_its_frame(people: Project, knowing: Knowing) -> None:
    def raising() -> None:
        raise ValueError("operands could not be broadcast")

    done = annotate(people, Wrapped(knowing("people"), key="000001", act=raising).pair(knowing("people")), FAST)
    assert keys(people, Status.DONE) == ["000000", "000002", "000003", "000004"]
    ((key, reason),) = done.failed
    assert key == "000001"
    assert reason.startswith("ValueError: operands could not be broadcast (test_annotate.py:")
    assert only_reason(people) == reason


def test_a_proposal_that_cannot_be_stored_affects_only_its_frame(
    people: Project, knowing: Knowing, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after removing a class from the project after the training."""
    replace, third = type(people.proposals).replace, people.frames.of()[3].id

    def renamed(self, frame_id, proposals, *rest, **named):
        robots = [dataclasses.replace(each, label="robot") for each in proposals]
        return replace(self, frame_id, robots if frame_id == third else proposals, *rest, **named)

    monkeypatch.setattr(type(people.proposals), "replace", renamed)
    done = annotate(people, knowing("people"), FAST)
    assert done.done == 4
    ((key, reason),) = done.failed
    assert key == "000003"
    assert "'robot' is not a class of the project" in reason


def test_annotate_can_be_limited_to_recordings_and_a_number_of_frames(
    make_project: Callable[..., Project], generated: Path, own_copy: Callable[[str], Path], knowing: Knowing
) -> None:
    project = make_project(own_copy("people"), generated / "people")
    first, second = project.recordings.all()
    done = annotate(project, knowing("people"), FAST, recordings=[second.id], limit=3)
    assert (done.frames, done.done, done.skipped) == (3, 3, 0)
    labelled = {stored.frame_id for stored in project.labels.select()}
    assert [f.id in labelled for f in project.frames.of([second.id])] == [True] * 3 + [False] * 2
    rest = annotate(project, knowing("people"), FAST, recordings=[second.id])
    assert (rest.frames, rest.skipped) == (2, 3)
    assert project.labels.select(recordings=[first.id]) == ()


@pytest.mark.parametrize("limit", [0, -1])
def test_a_limit_below_1_is_refused(people: Project, knowing: Knowing, limit: int) -> None:
    with pytest.raises(ConfigError, match="give 1 or more"):
        annotate(people, knowing("people"), FAST, limit=limit)
    assert people.jobs.all() == ()


def test_frames_without_proposals_are_counted(people: Project, knowing: Knowing) -> None:
    blind = Mock(wraps=knowing("people").image, fingerprint="blind", detect=lambda images: [[] for _ in images])
    blind.labels = ("person",)
    done = annotate(people, Detectors(blind, knowing("people").view), FAST)
    assert (done.done, done.proposals, done.without) == (5, 0, 5)
    assert keys(people, Status.DONE) == [f"{n:06d}" for n in range(5)]


def test_frames_start_from_the_previous_frames_reviewed_boxes_on_request(
    people: Project, knowing: Knowing, monkeypatch: pytest.MonkeyPatch
) -> None:
    warm, replace = dict[int, int](), Proposals.replace

    def counted(self: Proposals, frame_id: int, proposals: Sequence[Proposal], *args: Any, **options: Any) -> Replaced:
        warm[frame_id] = sum("warm start" in repr(each.trace) for each in proposals)
        return replace(self, frame_id, proposals, *args, **options)

    monkeypatch.setattr(Proposals, "replace", counted)
    recording = open_recording(people.recordings.all()[0].path)
    truths = load_truth(recording, 0, recording.frame(0))
    first, second = people.frames.of()[:2]
    people.labels.create(first.id, [NewLabel(truth.label, truth.box) for truth in truths], WriteContext(0, "me"))
    engine = InlineEngine(knowing("people"))
    told = {}
    for from_reviewed in (False, True, True):
        done = annotate_with(people, engine, FAST, limit=2, from_reviewed=from_reviewed)
        told[from_reviewed] = [warm[frame.id] for frame in (first, second)]
        assert done.skipped == (2 if len(people.jobs.all()) == 3 else 0), "processed again once, and then skipped"
    assert told[False] == [0, 0]
    assert told[True][0] == 0 and told[True][1] > 0
    assert [json.loads(run.config)["from_reviewed"] for run in people.jobs.all()] == [False, True, True]


@pytest.mark.parametrize("times", [WRITE_ATTEMPTS - 1, WRITE_ATTEMPTS])
def test_a_concurrent_write_is_retried(
    people: Project, knowing: Knowing, monkeypatch: pytest.MonkeyPatch, times: int
) -> None:
    """An operator writes between reading the revision and storing the proposals, which are then stored on top."""
    _interrupt(people, monkeypatch, times)
    done = annotate(people, knowing("people"), FAST, limit=2)
    if times < WRITE_ATTEMPTS:
        assert (done.done, done.failed) == (2, [])
        assert people.frames.of()[0].revision == times + 1
        assert len(people.labels.of_frame(people.frames.of()[0].id)) == 3
    else:  # again and again: only that frame fails
        assert done.done == 1
        assert "the change was made on revision" in done.failed[0][1]


def _interrupt(project: Project, monkeypatch: pytest.MonkeyPatch, times: int) -> None:
    """Inserts another write between reading the revision and the write, `times` times."""
    replace, left = type(project.proposals).replace, [times]

    def interrupted(self, frame_id, *rest, **named):
        if left[0] > 0:
            left[0] -= 1
            bump(project, 0)
        return replace(self, frame_id, *rest, **named)

    monkeypatch.setattr(type(project.proposals), "replace", interrupted)


def test_a_frame_finalised_during_processing_is_not_changed(people: Project, knowing: Knowing) -> None:
    stored = people.frames.of()[1]
    image = Wrapped(
        knowing("people"), key=stored.key, act=lambda: people.frames.finalise(stored.id, WriteContext(0, "me"))
    )
    done = annotate(people, image.pair(knowing("people")), FAST)
    assert (done.frames, done.done, done.skipped, done.failed) == (4, 4, 1, [])
    assert people.labels.of_frame(stored.id) == ()


def test_a_store_that_cannot_be_written_ends_the_batch(
    people: Project, knowing: Knowing, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise ProjectError("project.db: cannot be written, because the disk is full")

    monkeypatch.setattr(type(people.proposals), "replace", full)
    monkeypatch.setattr(type(people.jobs), "record_failure", full)
    with pytest.raises(ProjectError, match="the disk is full"):
        annotate(people, knowing("people"), FAST, limit=1)


def test_results_of_an_earlier_calibration_are_not_stored(people: Project, knowing: Knowing) -> None:
    recording = people.recordings.all()[0]
    turned = Correction((0.0, 0.02, 0.0))
    views = knowing("people")
    meddling = Wrapped(views, key="000002", act=lambda: people.adjustments.correct(recording.id, turned, "me"))
    done = annotate(people, meddling.pair(views), FAST)
    assert done.done + len(done.failed) == 5
    assert done.failed
    assert all("was changed during the run" in reason for _, reason in done.failed)
    # the detectors of the test only know the recorded frames; frames that were done before are annotated again, too
    people.adjustments.correct(recording.id, NO_CORRECTION, "me")
    again = annotate(people, views, FAST)
    assert (again.done, again.skipped, again.failed) == (5, 0, [])
    assert annotate(people, views, FAST).skipped == 5


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
