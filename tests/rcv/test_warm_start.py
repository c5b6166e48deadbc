"""Warm starts from an earlier box, and the first look of a class-agnostic detector."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA, Counting, frame_with, some_box
from scipy.spatial.transform import Rotation

from annotator.detection.perfect import PerfectDetector
from annotator.geometry.iou import iou_3d
from annotator.geometry.outline import box_on_image
from annotator.rcv.config import AGNOSTIC_LABELS, Orientation, RcvConfig, Strategy
from annotator.rcv.propose import propose, propose_from_boxes
from annotator.rcv.starts import WARM_START, WarmStart, is_warm, match_warm_starts
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind, Detector, Image, OrientedBox, Proposal
from annotator.workflows.detectors import Detectors
from annotator.workflows.recorded.reading import load_truth

UP = np.array([0.0, -1.0, 0.0])
BOX = some_box([0.2, 0.1, 2.0], [0.5, 0.6, -0.4], [0.5, 0.3, 0.2])
OTHER = some_box([-0.5, 0.0, 2.4], [-0.4, 0.3, 0.9], [0.3, 0.35, 0.25])


def changed(box: OrientedBox, shift: list[float], turn: list[float] | None = None) -> OrientedBox:
    rotation = Rotation.from_rotvec(turn or [0.0, 0.0, 0.0]).as_matrix() @ box.rotation
    return OrientedBox.from_parts(box.center_m + shift, rotation, box.size_m)


def run(
    start_box: OrientedBox, config: RcvConfig | None = None, jitter: float = 0.0, label: str = "thing"
) -> tuple[Proposal, list[int]]:
    frame, truths = frame_with([BOX], up=UP)
    perfect = PerfectDetector.for_frame(frame, truths, jitter=jitter)
    calls = Counting(perfect)
    (found,) = propose([frame], perfect, calls, config or RcvConfig(), [[WarmStart(label, start_box)]])[0].proposals
    return found, calls.calls


def test_a_good_start_box_takes_one_step_of_six_views() -> None:
    found, pictures = run(changed(BOX, [0.03, 0.02, -0.04], [0.05, -0.1, 0.05]))
    assert is_warm(found)
    assert pictures == [6]
    # the start box counts as a measurement, so it still has an effect after one step
    assert iou_3d(found.box, BOX) > 0.94
    assert found.trace[0].fallback == (WARM_START,)


@pytest.mark.parametrize(
    ("start_box", "reason"),
    [
        (changed(BOX, [0.0, 0.0, 0.2]), ""),  # 20 cm nearer or farther hardly changes the image box
        (some_box([0.2, 0.1, 2.0], [0.5, 0.6, -0.4], [0.5, 0.3, 0.45]), "a side is"),
        (changed(BOX, [0.0, 0.0, 0.0], [0.0, 0.0, 1.2]), ""),
    ],
    ids=["farther", "another size", "wrong rotation"],
)
def test_a_disagreeing_start_box_is_dropped_and_the_object_is_found(start_box: OrientedBox, reason: str) -> None:
    found, _ = run(start_box)
    plain, _ = run(start_box, label="another class")
    assert not is_warm(found)
    note = found.trace[0].fallback[0]
    assert note.startswith(f"{WARM_START}: ") and reason in note
    assert found.trace[0].strategy == Strategy.CAMERA
    assert len(found.trace[0].views) == 2
    # the result is exactly that of an object without a warm start
    np.testing.assert_array_equal(found.box.pose, plain.box.pose)
    assert plain.trace[0].fallback == ()
    assert plain.trace[1:] == found.trace[1:]


def test_warm_starts_are_matched_one_to_one_by_class_and_overlap() -> None:
    shifted = [changed(BOX, [0.05, 0.0, 0.0]), changed(OTHER, [0.04, 0.0, 0.0])]
    image = [box_on_image(CAMERA, OTHER, "thing"), box_on_image(CAMERA, BOX, "thing")]
    starts = [
        WarmStart("thing", shifted[0]),
        WarmStart("thing", shifted[1]),
        WarmStart("other", OTHER),
        WarmStart("thing", shifted[0]),
    ]
    matched = match_warm_starts(CAMERA, image, starts)
    for found, box in zip(matched, (OTHER, BOX), strict=True):
        assert found is not None and np.linalg.norm(found.center_m - box.center_m) < 0.01
    assert match_warm_starts(CAMERA, image, []) == [None, None]
    assert match_warm_starts(CAMERA, [], starts) == []


def test_a_tilted_start_box_gives_an_upright_box_from_silhouettes() -> None:
    box = some_box([-0.3, 0.0, 2.5], [np.pi / 2, 0, 0], [0.6, 0.8, 0.3])
    frame, truths = frame_with([box], up=UP)
    perfect = PerfectDetector.for_frame(frame, truths, kind=BoxKind.SILHOUETTE)
    config = RcvConfig(orientation=Orientation.UPRIGHT, box_kind=BoxKind.SILHOUETTE)
    starts = [[WarmStart("thing", changed(box, [0.02, 0, 0], [0.05, 0.05, 0.05]))]]
    (found,) = propose([frame], perfect, perfect, config, starts)[0].proposals
    assert is_warm(found)
    assert len(found.trace) <= 2
    assert abs(found.box.rotation[:, 2] @ UP) > 1 - 1e-9


class AnyClass:
    """A class-agnostic detector that gives the boxes of another detector under the names of what they measure."""

    labels = tuple(AGNOSTIC_LABELS.values())
    fingerprint = "any class"

    def __init__(self, detector: Detector, kind: BoxKind = BoxKind.BOX) -> None:
        self._detector, self._kind = detector, kind

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        label = AGNOSTIC_LABELS[self._kind]
        return [[replace(box, label=label) for box in boxes] for boxes in self._detector.detect(images)]


def first_look(orientation: Orientation) -> RcvConfig:
    """Settings with which no class has a typical size."""
    return RcvConfig(orientation=orientation, use_typical_sizes=False).for_detector(BoxKind.BOX, class_agnostic=True)


@pytest.mark.parametrize(("name", "least"), [("people", 0.85), ("hands", 0.75)])
def test_objects_of_any_class_are_measured(
    generated, knowing: Callable[..., Detectors], name: str, least: float
) -> None:
    recording = open_recording(generated / name)
    frame = recording.frame(0)
    truths = load_truth(recording, 0, frame)
    boxes = [box_on_image(frame.camera, truth.box, truth.label) for truth in truths]
    orientation = Orientation.UPRIGHT if name == "people" else Orientation.FREE
    config = first_look(orientation)
    view = AnyClass(knowing(name).view)
    (result,) = propose_from_boxes([frame], [boxes], view, config)
    assert len(result.proposals) == len(truths)
    for proposal in result.proposals:
        truth = truths[[box is proposal.image_box for box in boxes].index(True)]
        assert iou_3d(proposal.box, truth.box) > least
        assert proposal.label == truth.label
        assert {box.label for step in proposal.trace for view in step.views for box in view.boxes} == {truth.label}
    # the detector's other class is not used
    (none,) = propose_from_boxes([frame], [boxes], AnyClass(knowing(name).view, BoxKind.SILHOUETTE), config)
    assert none.proposals == ()
    assert len(none.lost) == len(truths)


def test_a_dropped_start_box_is_followed_by_a_first_look(generated, knowing: Callable[..., Detectors]) -> None:
    recording = open_recording(generated / "people")
    frame = recording.frame(0)
    truth = load_truth(recording, 0, frame)[0]
    image_box = box_on_image(frame.camera, truth.box, truth.label)
    config = first_look(Orientation.UPRIGHT)
    view = AnyClass(knowing("people").view)
    good = WarmStart(truth.label, truth.box)
    wrong = WarmStart(truth.label, OrientedBox(truth.box.pose, truth.box.size_m * [1, 1, 0.4]))
    for start, dropped in ((good, False), (wrong, True)):
        (result,) = propose_from_boxes([frame], [[image_box]], view, config, [[start]])
        assert iou_3d(result.proposals[0].box, truth.box) > 0.85
        assert result.proposals[0].trace[0].fallback[0].startswith("warm start: ") == dropped
