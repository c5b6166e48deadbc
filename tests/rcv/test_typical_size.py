"""Objects of a class with a typical size: the evidence for a box, where it may be, and which box is best.

A trained detector looks at the frustum before such a box is placed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from test_warm_start import AnyClass

from annotator.detection.perfect import PerfectDetector
from annotator.geometry.iou import iou_3d
from annotator.geometry.outline import box_on_image
from annotator.rcv import pseudo_view
from annotator.rcv.config import AGNOSTIC_LABELS, Orientation, RcvConfig, TypicalSize, typical_size
from annotator.rcv.first_look import Outline
from annotator.rcv.propose import propose_from_boxes
from annotator.rcv.starts import NOT_SEEN, TYPICAL_SIZE
from annotator.rcv.typical_size import BY_SCORE, Candidates, Evidence, place
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind, Camera, Detector, Frame, Image, OrientedBox, PointCloud, Truth
from annotator.workflows.detectors import Detectors
from annotator.workflows.recorded.reading import load_truth

CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
UP = np.array([0.0, -1.0, 0.0])
# 0.8 x 0.4 x 0.3 m, upright: z against gravity, turned by 40 degrees about it
_ANGLE = np.deg2rad(40)
_AXES = np.array([[np.cos(_ANGLE), -np.sin(_ANGLE), 0.0], [0.0, 0.0, -1.0], [np.sin(_ANGLE), np.cos(_ANGLE), 0.0]])
BOX = OrientedBox.from_parts(np.array([0.2, 0.1, 3.0]), _AXES, np.array([0.8, 0.4, 0.3]))
TYPICAL = TypicalSize(label="crate", size_m=(0.85, 0.38, 0.3), spread=(0.1, 0.1, 0.1))


def surface(box: OrientedBox, camera: Camera = CAMERA, step_px: int = 4) -> np.ndarray:
    """The points of the visible surface of a box, on rays through every few pixels."""
    u, v = np.meshgrid(np.arange(0, camera.width_px, step_px), np.arange(0, camera.height_px, step_px))
    rays = np.column_stack([(u.ravel() - camera.cx) / camera.fx, (v.ravel() - camera.cy) / camera.fy, np.ones(u.size)])
    origin, along = -box.center_m @ box.rotation, rays @ box.rotation
    with np.errstate(divide="ignore"):
        ends = np.sort(np.stack([(s * box.size_m / 2 - origin) / along for s in (-1, 1)]), axis=0)
    enter, leave = ends[0].max(axis=1), ends[1].min(axis=1)
    hit = (enter < leave) & (enter > 0)
    return (rays[hit] * enter[hit, None]).astype(np.float32)


def as_drawn(image_box: Box2D) -> Outline:
    return Outline(image_box, np.full(4, 2.0))


def evidence_of(
    box: OrientedBox, extra: Sequence[np.ndarray] = (), typical: TypicalSize = TYPICAL, up: np.ndarray | None = UP
) -> Evidence:
    image_box = box_on_image(CAMERA, box, typical.label)
    evidence = Evidence.of(CAMERA, np.concatenate([surface(box), *extra]), image_box, as_drawn(image_box), typical, up)
    assert evidence is not None
    return evidence


@pytest.mark.parametrize(("up", "least"), [(UP, 0.75), (None, 0.55)])
def test_a_box_of_typical_size_is_placed_without_a_detector(up: np.ndarray | None, least: float) -> None:
    wall = np.column_stack([np.random.default_rng(0).uniform(-1.5, 1.5, (600, 2)), np.full(600, 4.5)])
    evidence = evidence_of(BOX, [wall.astype(np.float32)], up=up)
    placed = place(evidence)
    assert len(placed) == BY_SCORE
    scores = evidence.score(placed)
    assert (np.diff(scores) <= 1e-12).all()
    assert iou_3d(placed.boxes[0], BOX) > least
    if up is not None:
        assert placed.rotation[:, :, 2] @ up == pytest.approx(np.ones(BY_SCORE))
    again = place(evidence)
    assert np.array_equal(again.center_m, placed.center_m)


def test_a_given_size_counts_more_than_the_name() -> None:
    car = typical_size("Car")
    assert car is not None and car.size_m[0] > 3
    assert typical_size("traffic cone") == typical_size("Traffic_Cone") is not None
    assert typical_size("thing") is None
    own = TypicalSize(label="Car", size_m=(0.4, 0.2, 0.15), spread=(0.1, 0.1, 0.1))
    assert typical_size("Car", [own]) is own
    assert typical_size("car", [own]) is own
    assert typical_size("Van", [own]) == typical_size("van")


def test_an_image_box_where_the_distortion_has_no_inverse_gives_no_evidence() -> None:
    camera = Camera(640, 480, 400.0, 400.0, 319.5, 239.5, (-0.35, 0.0, 0.0, 0.0, 0.0))
    xyz = np.random.default_rng(0).uniform((-1, -0.3, 2), (-0.5, 0.3, 3), (100, 3)).astype(np.float32)
    outer, middle = Box2D("crate", 0.0, 150.0, 150.0, 330.0), Box2D("crate", 250.0, 180.0, 390.0, 300.0)
    assert Evidence.of(camera, xyz, outer, as_drawn(outer), TYPICAL, UP) is None
    inner = Evidence.of(camera, xyz, middle, as_drawn(middle), TYPICAL, UP)
    assert inner is not None
    assert np.isfinite(inner.score(Candidates.of([BOX]))).all()


class Blind:
    """A class-agnostic detector that detects nothing."""

    labels = tuple(AGNOSTIC_LABELS.values())
    fingerprint = "blind"

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        return [[] for _ in images]


def frame_with(*boxes: OrientedBox) -> Frame:
    xyz = np.concatenate([surface(box) for box in boxes])
    rgb = np.zeros((CAMERA.height_px, CAMERA.width_px, 3), np.uint8)
    return Frame("000000", 0, CAMERA, rgb, PointCloud(xyz, np.full((len(xyz), 3), 128, np.uint8)), up=UP)


def config_for(*sizes: TypicalSize, use: bool = True) -> RcvConfig:
    config = RcvConfig(orientation=Orientation.UPRIGHT, typical_sizes=sizes, use_typical_sizes=use)
    return config.for_detector(BoxKind.BOX, class_agnostic=True)


def test_an_object_of_typical_size_needs_no_detection() -> None:
    frame, image_box = frame_with(BOX), box_on_image(CAMERA, BOX, "crate")
    (result,) = propose_from_boxes([frame], [[image_box]], Blind(), config_for(TYPICAL))
    (proposal,) = result.proposals
    assert iou_3d(proposal.box, BOX) > 0.7
    assert proposal.trace[0].fallback[:1] == (TYPICAL_SIZE,)
    assert proposal.score < 0.3  # nothing has confirmed it
    for config in (config_for(), config_for(TYPICAL, use=False)):
        (result,) = propose_from_boxes([frame], [[image_box]], Blind(), config)
        assert result.proposals == () and len(result.lost) == 1


def test_views_correct_the_placed_box(generated, knowing: Callable[..., Detectors]) -> None:
    """Perfect detections leave little of an only roughly right typical size."""
    recording = open_recording(generated / "people")
    frame = recording.frame(0)
    truth = load_truth(recording, 0, frame)[0]
    image_box = box_on_image(frame.camera, truth.box, truth.label)
    length, width, height = (float(side) for side in truth.box.size_m * [1.3, 0.8, 1.1])
    rough = TypicalSize(label=truth.label, size_m=(length, width, height), spread=(0.3, 0.3, 0.3))
    config = config_for(rough)
    (blind,) = propose_from_boxes([frame], [[image_box]], Blind(), config)
    (seen,) = propose_from_boxes([frame], [[image_box]], AnyClass(knowing("people").view), config)
    assert iou_3d(seen.proposals[0].box, truth.box) > max(0.7, iou_3d(blind.proposals[0].box, truth.box))


def start_config(orientation: Orientation, trained: bool) -> RcvConfig:
    config = RcvConfig(orientation=orientation, typical_sizes=(TYPICAL,), refine_steps=0)
    return config.for_detector(BoxKind.BOX, class_agnostic=True, trained=trained)


def seeing(frame: Frame) -> PerfectDetector:
    return PerfectDetector.for_frame(frame, [Truth(AGNOSTIC_LABELS[BoxKind.BOX], BOX)])


def boxed(frame: Frame, detector: Detector, config: RcvConfig) -> tuple[OrientedBox, tuple[str, ...]]:
    """The box of the crate, and what its trace says about its starts."""
    image_box = box_on_image(CAMERA, BOX, "crate")
    assert image_box is not None
    (result,) = propose_from_boxes([frame], [[image_box]], detector, config)
    (proposal,) = result.proposals
    return proposal.box, tuple(note for step in proposal.trace for note in step.fallback)


@pytest.mark.parametrize("orientation", [Orientation.FREE, Orientation.UPRIGHT])
@pytest.mark.parametrize(
    ("trained", "sees", "deep"),
    [
        (False, True, False),  # the base detector: nothing better is known
        (True, True, False),
        (True, False, False),  # the look shows nothing
        (True, True, True),  # a look would show too little
    ],
)
def test_objects_of_a_typical_size_are_found_whatever_a_trained_detector_sees(
    monkeypatch: pytest.MonkeyPatch, orientation: Orientation, trained: bool, sees: bool, deep: bool
) -> None:
    monkeypatch.setattr(pseudo_view, "DEEP", 1e-3 if deep else 100.0)
    frame = frame_with(BOX)
    box, notes = boxed(frame, seeing(frame) if sees else Blind(), start_config(orientation, trained))
    assert iou_3d(box, BOX) > (0.85 if sees else 0.4)
    assert (NOT_SEEN in notes) == (trained and not sees)
    assert TYPICAL_SIZE in notes


def test_a_box_that_does_not_agree_with_the_image_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pseudo_view, "DEEP", 100.0)
    frame = frame_with(BOX)
    half = OrientedBox(BOX.pose, BOX.size_m * 0.4)
    wrong = PerfectDetector.for_frame(frame, [Truth(AGNOSTIC_LABELS[BoxKind.BOX], half)])
    assert NOT_SEEN in boxed(frame, wrong, start_config(Orientation.FREE, True))[1]
