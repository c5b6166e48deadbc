"""Warm starts: a correct start box saves steps, a wrong one costs only time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scenes import CAMERA, frame_with, some_box
from scipy.spatial.transform import Rotation

from annotator.detection.perfect import PerfectDetector, Scene
from annotator.geometry.iou import iou_3d
from annotator.geometry.outline import box_on_image
from annotator.rcv.config import Orientation, RcvConfig, Strategy
from annotator.rcv.propose import propose
from annotator.rcv.starts import WARM_START, WarmStart, is_warm, match_warm_starts
from annotator.types import Box2D, BoxKind, Frame, Image, OrientedBox, Proposal, PseudoView

UP = np.array([0.0, -1.0, 0.0])
BOX = some_box([0.2, 0.1, 2.0], [0.5, 0.6, -0.4], [0.5, 0.3, 0.2])
OTHER = some_box([-0.5, 0.0, 2.4], [-0.4, 0.3, 0.9], [0.3, 0.35, 0.25])


class Calls:
    """Wraps a detector and records the number of images of each call."""

    def __init__(self, inner: PerfectDetector) -> None:
        self.inner, self.pictures = inner, []

    labels = property(lambda self: self.inner.labels)
    fingerprint = property(lambda self: self.inner.fingerprint)

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        self.pictures.append(len(images))
        return self.inner.detect(images)


def changed(box: OrientedBox, shift: list[float], turn: list[float] | None = None) -> OrientedBox:
    rotation = Rotation.from_rotvec(turn or [0.0, 0.0, 0.0]).as_matrix() @ box.rotation
    return OrientedBox.from_parts(box.center_m + shift, rotation, box.size_m)


def run(
    start_box: OrientedBox, config: RcvConfig | None = None, jitter: float = 0.0, label: str = "thing"
) -> tuple[Proposal, list[int]]:
    frame, truths = frame_with([BOX], up=UP)
    perfect = PerfectDetector.for_frame(frame, truths, jitter=jitter)
    calls = Calls(perfect)
    (found,) = propose([frame], perfect, calls, config or RcvConfig(), [[WarmStart(label, start_box)]])[0].proposals
    return found, calls.pictures


def test_a_good_start_box_takes_one_step_of_six_views() -> None:
    found, pictures = run(changed(BOX, [0.03, 0.02, -0.04], [0.05, -0.1, 0.05]))
    assert is_warm(found)
    assert pictures == [6]
    # the start box counts as a measurement, so it still has an effect after one step
    assert iou_3d(found.box, BOX) > 0.94
    assert found.trace[0].fallback == (WARM_START,)


@pytest.mark.parametrize("jitter", [0.0, 0.02])
def test_two_steps_are_enough_if_the_object_has_rotated(jitter: float) -> None:
    found, pictures = run(changed(BOX, [0.02, 0.0, 0.0], [0.3, 0.1, -0.2]), jitter=jitter)
    assert is_warm(found)
    assert pictures == [6, 6]
    assert iou_3d(found.box, BOX) > (0.94 if jitter == 0 else 0.75)


@pytest.mark.parametrize(
    ("start_box", "reason"),
    [
        (changed(BOX, [0.0, 0.0, 0.2]), ""),  # 20 cm nearer or farther hardly changes the image box
        (changed(BOX, [0.0, 0.0, -0.2]), ""),
        (changed(BOX, [0.0, 0.0, 0.9]), ""),
        (some_box([0.2, 0.1, 2.0], [0.5, 0.6, -0.4], [0.5, 0.3, 0.45]), "a side is"),
        (changed(BOX, [0.0, 0.0, 0.0], [0.0, 0.0, 1.2]), ""),
    ],
    ids=["farther", "nearer", "behind", "another size", "wrong rotation"],
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


def test_another_objects_start_box_is_dropped_and_the_rest_of_the_batch_is_unaffected() -> None:
    first, truths_a = frame_with([BOX, OTHER], key="a")
    second, truths_b = frame_with([BOX], key="b", seed=1)
    perfect = PerfectDetector([Scene.of(first, truths_a), Scene.of(second, truths_b)])
    calls = Calls(perfect)
    # the first frame's only warm start overlaps the other object on the image
    stray = changed(OTHER, [0.0, 0.0, 0.25])
    results = propose(
        [first, second], perfect, calls, RcvConfig(), [[WarmStart("thing", stray)], [WarmStart("thing", BOX)]]
    )
    assert [len(r.proposals) for r in results] == [2, 1]
    for result, truths in zip(results, (truths_a, truths_b), strict=True):
        for truth in truths:
            assert max(iou_3d(truth.box, p.box) for p in result.proposals) > 0.99
    assert [is_warm(p) for p in results[1].proposals] == [True]
    assert not any(is_warm(p) for p in results[0].proposals)
    # one cold start with 2 views, and two warm starts with 6 each, of which one will be dropped
    assert calls.pictures[0] == 2 + 6 + 6
    assert calls.pictures[1] == 24 + 2


def test_warm_starts_are_matched_one_to_one_by_class_and_overlap() -> None:
    shifted = [changed(BOX, [0.05, 0.0, 0.0]), changed(OTHER, [0.04, 0.0, 0.0])]
    image = [box_on_image(CAMERA, OTHER, "thing"), box_on_image(CAMERA, BOX, "thing")]
    starts = [
        WarmStart("thing", shifted[0]),
        WarmStart("thing", shifted[1]),
        WarmStart("other", OTHER),
        WarmStart("thing", shifted[0]),
    ]
    matched = match_warm_starts(CAMERA, image, starts, RcvConfig())
    for found, box in zip(matched, (OTHER, BOX), strict=True):
        assert found is not None and np.linalg.norm(found.center_m - box.center_m) < 0.01
    assert match_warm_starts(CAMERA, image, [], RcvConfig()) == [None, None]
    assert match_warm_starts(CAMERA, [], starts, RcvConfig()) == []


@pytest.mark.parametrize("strategy", [Strategy.NORMALS, Strategy.CONSENSUS])
def test_tilted_start_boxes_give_upright_boxes_from_silhouettes(strategy: Strategy) -> None:
    box = some_box([-0.3, 0.0, 2.5], [np.pi / 2, 0, 0], [0.6, 0.8, 0.3])
    frame, truths = frame_with([box], up=UP)
    perfect = PerfectDetector.for_frame(frame, truths, kind=BoxKind.SILHOUETTE)
    config = RcvConfig(strategy=strategy, orientation=Orientation.UPRIGHT, box_kind=BoxKind.SILHOUETTE)
    starts = [[WarmStart("thing", changed(box, [0.02, 0, 0], [0.05, 0.05, 0.05]))]]
    (found,) = propose([frame], perfect, perfect, config, starts)[0].proposals
    assert is_warm(found)
    assert len(found.trace) <= 2
    assert abs(found.box.rotation[:, 2] @ UP) > 1 - 1e-9


def test_an_object_without_points_around_the_start_box_starts_from_its_frustum() -> None:
    found, _ = run(changed(BOX, [0.0, 0.0, 8.0]), RcvConfig.model_validate({"warm": {"min_image_iou": 0.01}}))
    assert "too few" in found.trace[0].fallback[0]
    assert iou_3d(found.box, BOX) > 0.99


def test_an_object_without_view_detections_is_lost_despite_a_warm_start() -> None:
    frame, truths = frame_with([BOX])
    perfect = PerfectDetector.for_frame(frame, truths)

    class Blind(Calls):
        def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
            assert all(isinstance(image, PseudoView) for image in images)
            return [[] for _ in images]

    assert isinstance(frame, Frame)
    result = propose([frame], perfect, Blind(perfect), RcvConfig(), [[WarmStart("thing", BOX)]])[0]
    (lost,) = result.lost
    assert lost.trace[0].fallback == (f"{WARM_START}: the views do not show the object",)
