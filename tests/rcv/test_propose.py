"""The whole recursion with a perfect detector, on scenes with known boxes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scenes import frame_with, some_box

from annotator.detection.perfect import PerfectDetector, Scene
from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import box_corners, contains
from annotator.geometry.outline import box_on_image
from annotator.rcv.config import Orientation, RcvConfig, Strategy
from annotator.rcv.finish import finish
from annotator.rcv.propose import propose
from annotator.rcv.recursion import ObjectState
from annotator.types import Box2D, BoxKind, Frame, Image, OrientedBox, StopReason

FREE_BOX = some_box([0.2, 0.1, 2.0], [0.5, 0.6, -0.4], [0.5, 0.3, 0.2])
UP = np.array([0.0, -1.0, 0.0])
UPRIGHT_BOX = some_box([-0.3, 0.0, 2.5], [0, 0.5, 0], [0.6, 0.8, 0.3])


class Counting:
    """Forwards calls and records the number of images of each."""

    def __init__(self, inner: PerfectDetector) -> None:
        self.inner, self.calls = inner, []

    labels = property(lambda self: self.inner.labels)
    fingerprint = property(lambda self: self.inner.fingerprint)

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        self.calls.append(len(images))
        return self.inner.detect(images)


class BlindAfter(Counting):
    """Detects nothing after the given number of calls."""

    def __init__(self, inner: PerfectDetector, calls: int) -> None:
        super().__init__(inner)
        self.left = calls

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        found = super().detect(images)
        self.left -= 1
        return found if self.left >= 0 else [[] for _ in images]


@pytest.mark.parametrize(
    ("orientation", "box"), [(Orientation.FREE, FREE_BOX), (Orientation.UPRIGHT, UPRIGHT_BOX)], ids=["free", "upright"]
)
def test_consensus_finds_the_exact_box(orientation: Orientation, box) -> None:
    frame, truths = frame_with([box], up=UP if orientation is Orientation.UPRIGHT else None)
    perfect = PerfectDetector.for_frame(frame, truths)
    (found,) = propose([frame], perfect, perfect, RcvConfig(orientation=orientation))[0].proposals
    assert iou_3d(found.box, box) > 0.99
    assert found.label == "thing"
    assert found.quality.view_disagreement < 0.01
    assert found.trace[-1].stop in (StopReason.AXES_CONVERGED, StopReason.BOX_CONVERGED)


@pytest.mark.parametrize("strategy", list(Strategy))
def test_every_strategy_gives_a_box_that_contains_the_object(strategy: Strategy) -> None:
    frame, truths = frame_with([FREE_BOX])
    perfect = PerfectDetector.for_frame(frame, truths)
    (found,) = propose([frame], perfect, perfect, RcvConfig(strategy=strategy))[0].proposals
    assert contains(found.box, frame.cloud.xyz_m[:800], 0.02).mean() > 0.99
    assert iou_3d(found.box, FREE_BOX) > 0.15
    assert found.trace[0].strategy == Strategy.CAMERA
    assert found.trace[1].strategy == strategy


def test_silhouettes_give_a_tight_box() -> None:
    frame, truths = frame_with([FREE_BOX])
    perfect = PerfectDetector.for_frame(frame, truths, kind=BoxKind.SILHOUETTE)
    (found,) = propose([frame], perfect, perfect, RcvConfig(box_kind=BoxKind.SILHOUETTE))[0].proposals
    assert iou_3d(found.box, FREE_BOX) > 0.6
    assert contains(found.box, frame.cloud.xyz_m[:800], 0.02).mean() > 0.97


def test_all_objects_of_all_frames_share_one_batch_per_step() -> None:
    first, truths_a = frame_with([UPRIGHT_BOX, some_box([0.9, 0, 2.2], [0, 0.2, 0], [0.4, 0.5, 0.3])], up=UP, key="a")
    second, truths_b = frame_with([some_box([0.1, 0, 2.0], [0, -0.4, 0], [0.5, 0.4, 0.3])], up=UP, key="b")
    perfect = PerfectDetector([Scene.of(first, truths_a), Scene.of(second, truths_b)])
    counting = Counting(perfect)
    results = propose([first, second], perfect, counting, RcvConfig(orientation=Orientation.UPRIGHT))
    assert [r.key for r in results] == ["a", "b"]
    assert [len(r.proposals) for r in results] == [2, 1]
    steps = max(len(p.trace) for r in results for p in r.proposals)
    assert len(counting.calls) == steps
    assert counting.calls[0] == 2 * 3


def test_two_objects_in_one_frustum_become_two_proposals() -> None:
    near = some_box([-0.15, 0.05, 1.6], [0, 0.3, 0], [0.25, 0.35, 0.2])
    far = some_box([0.2, 0.0, 2.8], [0, -0.4, 0], [0.4, 0.5, 0.3])
    frame, truths = frame_with([near, far], up=UP)
    perfect = PerfectDetector.for_frame(frame, truths)

    class OneFrustum(Counting):
        def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
            both = self.inner.detect(images)[0]
            return [
                [
                    Box2D(
                        "thing",
                        min(b.x_min for b in both),
                        min(b.y_min for b in both),
                        max(b.x_max for b in both),
                        max(b.y_max for b in both),
                    )
                ]
            ]

    found = propose([frame], OneFrustum(perfect), perfect, RcvConfig(orientation=Orientation.UPRIGHT))[0].proposals
    assert len(found) == 2
    for truth in truths:
        assert max(iou_3d(truth.box, p.box) for p in found) > 0.95


@pytest.mark.parametrize(("seen", "steps"), [(0, 1), (1, 2)])
def test_an_object_without_view_detections_is_lost_and_the_trace_shows_the_step(seen: int, steps: int) -> None:
    frame, truths = frame_with([FREE_BOX])
    perfect = PerfectDetector.for_frame(frame, truths)
    result = propose([frame], perfect, BlindAfter(perfect, seen), RcvConfig())[0]
    assert result.proposals == ()
    assert len(result.lost[0].trace) == steps
    assert result.lost[0].trace[-1].stop is StopReason.LOST
    coarse = propose([frame], perfect, BlindAfter(perfect, seen), RcvConfig(coarse_box=True))[0]
    (box,) = coarse.proposals
    assert contains(box.box, frame.cloud.xyz_m[:800], 0.02).mean() > 0.95
    assert box.score < 0.5 if seen == 0 else box.score > 0.5


def test_other_classes_in_the_views_are_ignored() -> None:
    frame, truths = frame_with([FREE_BOX])
    perfect = PerfectDetector.for_frame(frame, truths)

    class Renamed(Counting):
        def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
            return [[Box2D("other", *b.xyxy) for b in found] for found in self.inner.detect(images)]

    assert propose([frame], perfect, Renamed(perfect), RcvConfig())[0].proposals == ()


def test_an_empty_frustum_stops_with_too_few_points() -> None:
    frame, truths = frame_with([FREE_BOX])
    perfect = PerfectDetector.for_frame(frame, truths)

    class Corner(Counting):
        def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
            return [[Box2D("thing", 0.0, 0.0, 1.5, 1.5)] for _ in images]

    result = propose([frame], Corner(perfect), perfect, RcvConfig())[0]
    assert result.lost[0].trace[0].stop is StopReason.TOO_FEW_POINTS


@pytest.mark.parametrize("limit", [1, 2, 3])
def test_the_step_limit_holds(limit: int) -> None:
    frame, truths = frame_with([FREE_BOX])
    perfect = PerfectDetector.for_frame(frame, truths, jitter=0.05)
    config = RcvConfig(max_steps=limit, axes_tolerance_rad=1e-9, box_tolerance=1e-9)
    (found,) = propose([frame], perfect, perfect, config)[0].proposals
    assert len(found.trace) == limit
    assert found.trace[-1].stop is StopReason.STEP_LIMIT


def test_the_trace_maps_the_box_back_as_in_equation_1() -> None:
    """B_o = prod_i T_i^{i+1} B_N with the homogeneous 4 x 4 transforms between the frames of successive steps."""
    frame, truths = frame_with([FREE_BOX])
    perfect = PerfectDetector.for_frame(frame, truths, jitter=0.02)
    config = RcvConfig(strategy=Strategy.NORMALS)
    (found,) = propose([frame], perfect, perfect, config)[0].proposals
    frames = [np.eye(4)]
    for step in found.trace:
        pose = np.eye(4)
        pose[:3, :3] = np.array(step.views[0].axes).T
        frames.append(pose)
    last = found.trace[-1]
    spans = []
    for axis, view_index, row in ((0, 0, 0), (1, 0, 1), (2, 1, 0)):
        view = last.views[view_index]
        box = view.boxes[view.used]
        low, high = ((box.x_min, box.x_max), (box.y_min, box.y_max))[row]
        spans.append([view.origin_m[row] + edge * view.metres_per_px for edge in (low, high)])
        assert axis == len(spans) - 1
    side = last.views[1]
    shared = side.boxes[side.used]
    spans[1] = np.mean([spans[1], [side.origin_m[1] + e * side.metres_per_px for e in (shared.y_min, shared.y_max)]], 0)
    corners = np.array([[x, y, z, 1.0] for x in spans[0] for y in spans[1] for z in spans[2]]).T
    for earlier, later in zip(frames[-2::-1], frames[:0:-1], strict=True):
        corners = np.linalg.inv(earlier) @ later @ corners
    ours = box_corners(found.box)
    for corner in corners[:3].T:
        assert np.linalg.norm(ours - corner, axis=1).min() < 1e-9


def test_results_do_not_depend_on_the_rest_of_the_batch() -> None:
    first, truths_a = frame_with([FREE_BOX], key="a")
    second, truths_b = frame_with([UPRIGHT_BOX], key="b")
    perfect = PerfectDetector([Scene.of(first, truths_a), Scene.of(second, truths_b)], jitter=0.02)
    together = propose([first, second], perfect, perfect, RcvConfig())
    alone = [propose([frame], perfect, perfect, RcvConfig())[0] for frame in (first, second)]
    for a, b in zip(together, alone, strict=True):
        np.testing.assert_array_equal(box_corners(a.proposals[0].box), box_corners(b.proposals[0].box))
        assert a.proposals[0].trace == b.proposals[0].trace


def test_a_silhouette_that_misses_a_part_does_not_shrink_the_box() -> None:
    frame, truths = frame_with([UPRIGHT_BOX], up=UP)
    perfect = PerfectDetector.for_frame(frame, truths, kind=BoxKind.SILHOUETTE)

    class OneSmall(Counting):
        def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
            found = self.inner.detect(images)
            if len(found) > 2:
                b = found[2][0]
                found[2] = [Box2D(b.label, b.x_min + 0.7 * b.width_px, b.y_min, b.x_max, b.y_max, 0.3)]
            return found

    config = RcvConfig(orientation=Orientation.UPRIGHT, box_kind=BoxKind.SILHOUETTE)
    (found,) = propose([frame], perfect, OneSmall(perfect), config)[0].proposals
    assert contains(found.box, frame.cloud.xyz_m[:800], 0.02).mean() > 0.95


# The selection of a frame's final boxes by their agreement with the image boxes.


OWN = some_box([-0.3, 0.1, 2.2], [0, 0.5, 0], [0.6, 0.8, 0.3])
OTHER = some_box([0.9, 0.0, 3.0], [0, 0.2, 0], [0.4, 0.5, 0.3])


def seen(frame: Frame, box: OrientedBox) -> Box2D:
    found = box_on_image(frame.camera, box, "thing")
    assert found is not None
    return found


def ended(frame: Frame, image_box: Box2D, box: OrientedBox, points: slice = slice(0, 800)) -> ObjectState:
    mask = np.zeros(len(frame.cloud), bool)
    mask[points] = True
    stop = StopReason.BOX_CONVERGED
    cloud = frame.cloud.select(mask)
    return ObjectState(0, image_box, cloud, None, np.eye(3), box=box, view_score=0.9, stop=stop)


@pytest.fixture
def frame() -> Frame:
    return frame_with([OWN, OTHER])[0]


def result(frame: Frame, states: Sequence[ObjectState], **settings: object) -> list[OrientedBox]:
    return [p.box for p in finish(frame, states, RcvConfig(**settings)).proposals]


def test_a_disagreeing_second_object_is_dropped_but_never_the_best(frame: Frame) -> None:
    image_box = seen(frame, OWN)
    both = [ended(frame, image_box, OTHER), ended(frame, image_box, OWN)]
    assert len(result(frame, both, min_image_agreement=0.0)) == 2
    (kept,) = result(frame, both, min_image_agreement=0.2)
    assert kept is OWN
    assert len(result(frame, both[:1], min_image_agreement=1.0)) == 1, "the only object of its frustum is kept"


@pytest.mark.parametrize("order", [1, -1])
def test_of_duplicates_the_one_from_the_objects_own_frustum_is_kept(frame: Frame, order: int) -> None:
    own, neighbours = seen(frame, OWN), seen(frame, OTHER)
    better = ended(frame, own, OWN)
    worse = ended(frame, replace(neighbours, score=1.0), OrientedBox(OWN.pose, OWN.size_m * 0.9))
    (found,) = finish(frame, [worse, better][::order], RcvConfig(min_image_agreement=0.0)).proposals
    assert found.image_box == own
