"""The first look of a class-agnostic detector: crops along the depth, bounds from the image box, choice of a rival."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import box_corners
from annotator.geometry.outline import box_on_image
from annotator.rcv.config import AGNOSTIC_LABELS, FirstLookConfig, Orientation, RcvConfig
from annotator.rcv.first_look import Outline, depth_crops, expected_outline, image_planes, width_at
from annotator.rcv.propose import propose_from_boxes
from annotator.rcv.starts import WarmStart
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind, Camera, Detector, Image, OrientedBox
from annotator.workflows.detectors import Detectors
from annotator.workflows.recorded.reading import load_truth

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
BOX = OrientedBox.from_parts(np.array([0.1, -0.05, 2.0]), np.eye(3), np.array([0.4, 0.5, 0.3]))


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
    look = FirstLookConfig(use_typical_sizes=False)
    return RcvConfig(orientation=orientation, first_look=look).for_detector(BoxKind.BOX, class_agnostic=True)


def points_at(depths_m: Sequence[float], count: int = 200) -> np.ndarray:
    rng = np.random.default_rng(0)
    layers = [np.column_stack([rng.uniform(-0.1, 0.1, (count, 2)) * z, np.full(count, z)]) for z in depths_m]
    return np.concatenate(layers).astype(np.float32)


def test_each_layer_of_depth_gets_a_crop() -> None:
    image_box = Box2D("object", 130.0, 90.0, 190.0, 150.0)
    layers = (1.0, 2.0, 3.0, 5.0)
    xyz = points_at(layers)
    crops = depth_crops(CAMERA, xyz, image_box, FirstLookConfig(), 5)
    assert [sorted(set(xyz[crop, 2].tolist())) for crop in crops] == [[depth] for depth in layers]
    assert depth_crops(CAMERA, xyz, image_box, FirstLookConfig(), len(xyz)) == []


def test_a_crop_is_as_long_as_the_image_box_is_wide_there() -> None:
    image_box = Box2D("object", 100.0, 90.0, 165.0, 116.0)
    assert width_at(CAMERA, image_box, 2.0) == pytest.approx(0.5)
    xyz = np.column_stack([np.zeros((400, 2)), np.linspace(1, 5, 400)]).astype(np.float32)
    (crop,) = depth_crops(CAMERA, xyz, image_box, FirstLookConfig(depth_percentiles=(50.0,), lengths=(1.0,)), 5)
    assert np.ptp(xyz[crop, 2]) == pytest.approx(width_at(CAMERA, image_box, 3.0), abs=0.03)


def test_a_box_touches_the_planes_of_its_outline_from_inside() -> None:
    outline = box_on_image(CAMERA, BOX, "object")
    planes = image_planes(CAMERA, Outline(outline, np.full(4, 2.0)), 2.0)
    heights = box_corners(BOX) @ planes.directions.T
    assert len(planes.directions) == 4
    assert heights.max(axis=0) == pytest.approx(0, abs=1e-9)
    assert np.isinf(planes.sigma_m[:, 0]).all()
    assert planes.sigma_m[:, 1] == pytest.approx(2 * 2.0 / 260, rel=0.1)


def test_the_outline_of_a_whole_box_lies_outside_what_is_seen() -> None:
    config, image_box = RcvConfig(), Box2D("object", 100.0, 50.0, 200.0, 239.0)
    for image_kind, kind in ((BoxKind.BOX, BoxKind.BOX), (BoxKind.SILHOUETTE, BoxKind.SILHOUETTE)):
        same = expected_outline(CAMERA, image_box, config.for_detector(kind, True, image_kind))
        assert same.box is image_box and same.sigma_px == pytest.approx(2.0)
    whole = expected_outline(CAMERA, image_box, config.for_detector(BoxKind.BOX, True, BoxKind.SILHOUETTE))
    room = config.first_look.silhouette_room
    # the object may go on beyond the lower border of the image
    assert whole.box.xyxy == pytest.approx((100 - 100 * room, 50 - 189 * room, 200 + 100 * room, 239.0))
    assert (whole.sigma_px > 2).all()


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


def test_a_detector_of_the_class_sees_no_crops(generated, knowing: Callable[..., Detectors]) -> None:
    recording = open_recording(generated / "people")
    frame = recording.frame(0)
    truths = load_truth(recording, 0, frame)
    boxes = [box_on_image(frame.camera, truth.box, truth.label) for truth in truths]
    seen: list[int] = []

    class Counting(AnyClass):
        def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
            seen.append(len(images))
            return self._detector.detect(images)

    for class_agnostic in (False, True):
        config = RcvConfig(orientation=Orientation.UPRIGHT).for_detector(BoxKind.BOX, class_agnostic)
        propose_from_boxes([frame], [boxes], Counting(knowing("people").view), config)
        first = seen.copy()[0]
        seen.clear()
        assert (first == 2 * len(boxes)) is not class_agnostic


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


def test_settings_of_the_first_look_are_recorded_only_if_they_apply() -> None:
    assert "first_look" not in RcvConfig().record()
    assert RcvConfig().for_detector(BoxKind.BOX, class_agnostic=True).record()["class_agnostic"] is True
