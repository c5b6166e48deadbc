"""What an object starts from: a trained detector looks at the frustum before boxes of a typical size are placed."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from annotator.detection.perfect import PerfectDetector
from annotator.geometry.iou import iou_3d
from annotator.geometry.outline import box_on_image
from annotator.rcv import pseudo_view, starts
from annotator.rcv.config import AGNOSTIC_LABELS, Orientation, RcvConfig, TypicalSize
from annotator.rcv.propose import propose_from_boxes
from annotator.types import BoxKind, Detector, Frame, OrientedBox, Truth
from tests.rcv.test_typical_size import BOX, CAMERA, TYPICAL, Blind, frame_with

FREE, UPRIGHT = Orientation.FREE, Orientation.UPRIGHT


def config_for(orientation: Orientation, sizes: Sequence[TypicalSize], trained: bool) -> RcvConfig:
    config = RcvConfig(orientation=orientation, typical_sizes=tuple(sizes), refine_steps=0)
    return config.for_detector(BoxKind.BOX, class_agnostic=True, trained=trained)


def knowing(frame: Frame) -> PerfectDetector:
    return PerfectDetector.for_frame(frame, [Truth(AGNOSTIC_LABELS[BoxKind.BOX], BOX)])


def found(frame: Frame, detector: Detector, config: RcvConfig) -> tuple[OrientedBox, tuple[str, ...]]:
    """The box of the crate, and what its trace says about its starts."""
    image_box = box_on_image(CAMERA, BOX, "crate")
    assert image_box is not None
    (result,) = propose_from_boxes([frame], [[image_box]], detector, config)
    (proposal,) = result.proposals
    return proposal.box, tuple(note for step in proposal.trace for note in step.fallback)


@pytest.mark.parametrize("orientation", [FREE, UPRIGHT])
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
    box, notes = found(frame, knowing(frame) if sees else Blind(), config_for(orientation, [TYPICAL], trained))
    assert iou_3d(box, BOX) > (0.85 if sees else 0.4)
    assert (starts.NOT_SEEN in notes) == (trained and not sees)
    assert starts.TYPICAL_SIZE in notes


def test_a_box_that_does_not_agree_with_the_image_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pseudo_view, "DEEP", 100.0)
    frame = frame_with(BOX)
    half = OrientedBox(BOX.pose, BOX.size_m * 0.4)
    wrong = PerfectDetector.for_frame(frame, [Truth(AGNOSTIC_LABELS[BoxKind.BOX], half)])
    assert starts.NOT_SEEN in found(frame, wrong, config_for(FREE, [TYPICAL], True))[1]
