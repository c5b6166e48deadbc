"""The Python API detects, proposes, stores and exports, with the same results as the commands."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import annotator
from annotator.api.proposing import FunctionDetector
from annotator.types import BoxKind, DetectorKind, Region
from annotator.types.errors import ArgumentError, ConfigError, NotFoundError, ProjectError
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


HAND = annotator.NearestCluster("hand")


@pytest.fixture(scope="module")
def hands(generated: Path) -> annotator.Recording:
    return annotator.open_recording(generated / "hands")


@pytest.fixture(scope="module")
def knowing_all(hands: annotator.Recording) -> Any:
    return annotator.perfect_detector(hands, "box")


def overlaps(hands: annotator.Recording, index: int, found: annotator.FrameProposals) -> list[float]:
    truths = annotator.read_truth(hands, index)
    return [max(annotator.iou_3d(each.box, truth.box) for each in found.proposals) for truth in truths]


def test_propose_takes_one_frame_or_several(hands: annotator.Recording, knowing_all: Any) -> None:
    frames = [hands.frame(0), hands.frame(1)]
    boxes = knowing_all.detect(frames)
    several = annotator.propose(frames, image_boxes=boxes, view_detector=knowing_all, rotation="free")
    for index, found in enumerate(several):
        assert min(overlaps(hands, index, found)) > 0.95
    one = annotator.propose(frames[0], image_boxes=boxes[0], view_detector=knowing_all, rotation="free")
    assert one.key == frames[0].key and min(overlaps(hands, 0, one)) > 0.95
    detected = annotator.propose(frames[0], image_detector=knowing_all, view_detector=knowing_all, rotation="free")
    assert [x.box.center_m.tolist() for x in detected.proposals] == [x.box.center_m.tolist() for x in one.proposals]
    assert annotator.propose([], image_boxes=[], view_detector=knowing_all) == []


def test_functions_can_be_detectors(hands: annotator.Recording, knowing_all: Any) -> None:
    def on_image(frame: annotator.Frame) -> Sequence[annotator.Box2D]:
        assert frame.depth_m is not None
        return list(knowing_all.detect([frame])[0])

    def on_view(view: annotator.PseudoView) -> Sequence[annotator.Box2D]:
        return list(knowing_all.detect([view])[0])

    found = annotator.propose(
        hands.frame(0), image_detector=on_image, view_detector=on_view, box_kind="box", rotation="free"
    )
    assert min(overlaps(hands, 0, found)) > 0.95


def test_a_function_detector_gets_the_whole_frame_for_a_region(hands: annotator.Recording) -> None:
    frame = hands.frame(0)
    inside = annotator.Box2D("hand", 30.0, 40.0, 60.0, 70.0, 0.5)
    outside = annotator.Box2D("hand", 200.0, 200.0, 220.0, 220.0, 0.9)
    detector = FunctionDetector(lambda image: [inside, outside] if image is frame else [])
    assert [box.score for box in detector.detect([frame])[0]] == [0.9, 0.5]
    (found,) = detector.detect([Region(frame, 20, 30, 64, 64)])
    assert [box.xyxy for box in found] == [(10.0, 10.0, 40.0, 40.0)]


def test_nearest_cluster_boxes_the_nearer_of_two_groups() -> None:
    grid = np.stack(np.meshgrid(np.arange(10), np.arange(10), [0]), -1).reshape(-1, 3) * 0.02
    near, far = grid + np.array([0, 0, 1.0]), grid * 2 + np.array([0.5, 0, 2.0])
    speck = np.array([[0.0, 0, 0.2]])
    view = annotator.PseudoView(
        np.zeros((50, 100, 3), np.uint8),
        np.eye(3),
        0.01,
        np.array([0.0, 0.0]),
        np.vstack([far, near, speck]).astype(np.float32),
    )
    ((box,),) = HAND.detect([view])
    np.testing.assert_allclose(box.xyxy, (-0.5, -0.5, 18.5, 18.5), atol=1e-3)
    nothing = annotator.PseudoView(view.rgb, view.axes, 0.01, view.origin_m, np.zeros((0, 3), np.float32))
    assert HAND.detect([nothing]) == [[]]


def test_invalid_or_conflicting_arguments_are_errors(hands: annotator.Recording) -> None:
    frame, box = hands.frame(0), annotator.Box2D("hand", 10.0, 10.0, 50.0, 50.0)

    def refused(match: str, frames: Any = frame, **given: Any) -> None:
        with pytest.raises((ArgumentError, ConfigError), match=match):
            annotator.propose(frames, **{"view_detector": HAND, **given})

    refused("either image_boxes or image_detector")
    refused("either image_boxes or image_detector", image_boxes=[box], image_detector=HAND)
    refused("1 list for 2 frames", [frame, frame], image_boxes=[[box]])
    refused("one list of boxes per frame", [frame, frame], image_boxes=[box, box])
    refused("rotation must be one of", image_boxes=[box], rotation="tilted")
    refused("box_kind must be one of", image_boxes=[box], box_kind="outline")
    refused("there is no such setting", image_boxes=[box], settings={"max_step": 3})
    refused("edges in 0..1", image_boxes=[annotator.Box2D("hand", 0.1, 0.2, 0.5, 0.6)])
    refused("outside the image", image_boxes=[annotator.Box2D("hand", 5000.0, 10.0, 5050.0, 50.0)])
    refused("is not a detector", image_detector="yolo")
    refused("must be Box2D", image_boxes=[(10, 10, 50, 50)])
    refused("must be a Frame", ["frame"], image_boxes=[[box]])


def test_settings_reach_the_recursion(hands: annotator.Recording, knowing_all: Any) -> None:
    found = annotator.propose(
        hands.frame(0), image_detector=knowing_all, view_detector=knowing_all, settings={"max_steps": 1}
    )
    assert {len(each.trace) for each in found.proposals} == {1}


def test_watch_reads_each_frame_only_when_needed(hands: annotator.Recording, knowing_all: Any) -> None:
    asked: list[int] = []

    def camera() -> Iterator[annotator.Frame]:
        for index in range(3):
            asked.append(index)
            yield hands.frame(index)

    seen = annotator.watch(camera(), image_detector=knowing_all, view_detector=knowing_all, rotation="free")
    assert asked == []
    first = next(seen)
    assert (asked, first.seeded, first.frame.key) == ([0], 0, hands.keys[0])
    assert min(overlaps(hands, 0, first.found)) > 0.95
    assert next(seen).frame.key == hands.keys[1]
    assert len(list(seen)) == 1


def test_labels_can_be_written_read_and_evaluated(hands: annotator.Recording, tmp_path: Path) -> None:
    frames = [hands.frame(0), hands.frame(1)]
    truth = {frame.key: annotator.read_truth(hands, i, frame) for i, frame in enumerate(frames)}
    annotator.write_labels(tmp_path / "boxes.json", truth)
    again = annotator.read_labels(tmp_path / "boxes.json")
    assert list(again.frames) == list(truth)
    read = {name: again.truths(name, frame) for name, frame in zip(again.frames, frames, strict=True)}
    assert [x.track_id for x in read[frames[0].key]] == [x.track_id for x in truth[frames[0].key]]
    report = annotator.evaluate(read, truth)
    row = dict(zip(report.columns, report.rows[0], strict=True))
    assert (row["class"], row["objects"], row["detections"], row["AP 0.7"]) == ("hand", 4, 4, 1.0)
    with pytest.raises(ArgumentError, match="format must be one of boxes, rcv"):
        annotator.read_labels(tmp_path, "pascal")
    with pytest.raises(ArgumentError, match="angles must be one of radians, degrees, not 'grads'"):
        annotator.read_labels(tmp_path, "kitti", "grads")
    with pytest.raises(ArgumentError, match="no frame in common"):
        annotator.evaluate({"other": ()}, truth)
    with pytest.raises(ArgumentError, match="has no box"):
        annotator.evaluate(truth, {})


def test_boxes_are_drawn(hands: annotator.Recording) -> None:
    frame = hands.frame(0)
    boxes = [*annotator.read_truth(hands, 0, frame), annotator.Box2D("hand", 5.0, 6.0, 30.0, 40.0)]
    picture = annotator.draw_boxes(frame, boxes)
    changed = (picture != frame.rgb).any(axis=2)
    assert 200 < changed.sum() < 0.2 * changed.size and changed[20, 5]
    behind = annotator.OrientedBox.from_parts(np.array([0.0, 0, -2]), np.eye(3), np.ones(3))
    assert (annotator.draw_boxes(frame, [behind]) == frame.rgb).all()
