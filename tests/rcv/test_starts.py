"""What an object starts from: a trained detector looks at the frustum before boxes of a typical size are placed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scenes import Counting

from annotator.detection.perfect import PerfectDetector
from annotator.geometry.iou import iou_3d
from annotator.geometry.outline import box_on_image
from annotator.rcv import starts
from annotator.rcv.config import AGNOSTIC_LABELS, Orientation, RcvConfig, TypicalSize, ViewConfig
from annotator.rcv.propose import propose_from_boxes
from annotator.rcv.typical_size import Candidates, Evidence, place
from annotator.types import BoxKind, Detector, Frame, OrientedBox, Truth
from tests.rcv.test_typical_size import BOX, CAMERA, TYPICAL, Blind, frame_with

FREE, UPRIGHT = Orientation.FREE, Orientation.UPRIGHT
# Views of a step: front and side of each hypothesis.
NEAR, WIDE = {FREE: 6, UPRIGHT: 6}, {FREE: 24, UPRIGHT: 8}


def config_for(orientation: Orientation, sizes: Sequence[TypicalSize], trained: bool, deep: bool = False) -> RcvConfig:
    view = ViewConfig(deep=1e-3 if deep else 100.0)
    config = RcvConfig(orientation=orientation, typical_sizes=tuple(sizes), view=view)
    config = config.model_copy(update={"consensus": config.consensus.model_copy(update={"refine_steps": 0})})
    return config.for_detector(BoxKind.BOX, class_agnostic=True, trained=trained)


def knowing(frame: Frame) -> PerfectDetector:
    return PerfectDetector.for_frame(frame, [Truth(AGNOSTIC_LABELS[BoxKind.BOX], BOX)])


@pytest.fixture
def placed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows by one with each placement in a whole frustum."""
    calls: list[int] = []

    def counted(evidence: Evidence) -> Candidates:
        calls.append(1)
        return place(evidence)

    monkeypatch.setattr(starts, "place", counted)
    return calls


def found(frame: Frame, detector: Detector, config: RcvConfig) -> tuple[OrientedBox, tuple[str, ...], list[int]]:
    """The box of the crate, what its trace says about its starts, and the views of each step."""
    counting = Counting(detector)
    image_box = box_on_image(CAMERA, BOX, "crate")
    assert image_box is not None
    (result,) = propose_from_boxes([frame], [[image_box]], counting, config)
    (proposal,) = result.proposals
    return proposal.box, tuple(note for step in proposal.trace for note in step.fallback), counting.calls


@pytest.mark.parametrize("orientation", [FREE, UPRIGHT])
@pytest.mark.parametrize(
    ("trained", "sees", "deep", "placements", "looks"),
    [
        (False, True, False, 1, False),  # the base detector: nothing better is known
        (True, True, False, 0, True),
        (True, False, False, 1, True),  # the look shows nothing
        (True, True, True, 1, False),  # a look would show too little
    ],
)
def test_boxes_are_placed_only_if_a_trained_detector_sees_nothing(
    placed: list[int], orientation: Orientation, trained: bool, sees: bool, deep: bool, placements: int, looks: bool
) -> None:
    frame = frame_with(BOX)
    config = config_for(orientation, [TYPICAL], trained, deep)
    box, notes, views = found(frame, knowing(frame) if sees else Blind(), config)
    assert iou_3d(box, BOX) > (0.85 if sees else 0.4)
    assert len(placed) == placements
    assert (views[0] == 2) == looks
    assert (starts.NOT_SEEN in notes) == (looks and not sees)
    assert starts.TYPICAL_SIZE in notes
    if not placements:
        # rivals share the hypotheses, of which each upright one keeps the least number
        assert views[1] <= (WIDE[FREE] if orientation is FREE else 2 * WIDE[UPRIGHT])
    elif sees:
        rivals = views[0] // NEAR[orientation]
        assert 1 <= rivals <= starts.STARTS and views[1] == rivals * WIDE[orientation]


@pytest.mark.parametrize("orientation", [FREE, UPRIGHT])
def test_without_a_typical_size_training_changes_nothing(placed: list[int], orientation: Orientation) -> None:
    frame = frame_with(BOX)
    outcomes = [found(frame, knowing(frame), config_for(orientation, [], trained)) for trained in (False, True)]
    (before, *facts), (after, *same) = outcomes
    assert facts == same and not placed
    assert np.array_equal(before.center_m, after.center_m) and np.array_equal(before.size_m, after.size_m)


def test_a_box_that_does_not_agree_with_the_image_is_not_used(placed: list[int]) -> None:
    frame = frame_with(BOX)
    half = OrientedBox(BOX.pose, BOX.size_m * 0.4)
    wrong = PerfectDetector.for_frame(frame, [Truth(AGNOSTIC_LABELS[BoxKind.BOX], half)])
    _, notes, _ = found(frame, wrong, config_for(FREE, [TYPICAL], True))
    assert placed and starts.NOT_SEEN in notes
