"""The whole recursion with a perfect detector, on scenes with known boxes; and the axes that strategies give."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scenes import Counting, box_surface, frame_with, some_box

from annotator.detection.perfect import PerfectDetector, Scene
from annotator.geometry.iou import iou_3d
from annotator.geometry.normals import normals_knn
from annotator.geometry.oriented_box import box_corners, contains
from annotator.rcv.axes import axes_angle_rad, find_axes
from annotator.rcv.config import Orientation, RcvConfig, Strategy
from annotator.rcv.propose import propose
from annotator.types import Box2D, BoxKind, Image, PointCloud, StopReason

FREE = RcvConfig(orientation=Orientation.FREE)
FREE_BOX = some_box([0.2, 0.1, 2.0], [0.5, 0.6, -0.4], [0.5, 0.3, 0.2])
UP = np.array([0.0, -1.0, 0.0])
UPRIGHT_BOX = some_box([-0.3, 0.0, 2.5], [0, 0.5, 0], [0.6, 0.8, 0.3])


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


def test_two_objects_in_one_frustum_become_two_proposals() -> None:
    near = some_box([-0.15, 0.05, 1.6], [0, 0.3, 0], [0.25, 0.35, 0.2])
    far = some_box([0.2, 0.0, 2.8], [0, -0.4, 0], [0.4, 0.5, 0.3])
    frame, truths = frame_with([near, far], up=UP)
    perfect = PerfectDetector.for_frame(frame, truths)

    class OneFrustum(Counting):
        def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
            corners = np.array([box.xyxy for box in self.inner.detect(images)[0]])
            return [[Box2D("thing", *corners[:, :2].min(axis=0).tolist(), *corners[:, 2:].max(axis=0).tolist())]]

    for image in (OneFrustum(perfect), perfect):  # of two frustums that overlap, each object is kept once
        found = propose([frame], image, perfect, RcvConfig(orientation=Orientation.UPRIGHT))[0].proposals
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


def test_eigenvectors_of_a_long_box_are_its_axes() -> None:
    box = some_box([0, 0, 3], [0.3, 0.5, -0.2], [1.0, 0.5, 0.2])
    cloud = PointCloud(box_surface(box, 3000, np.random.default_rng(0)).astype(np.float32))
    found = find_axes(cloud, Strategy.EIGENVECTORS, np.eye(3), None, FREE)
    assert found.strategy is Strategy.EIGENVECTORS
    assert axes_angle_rad(found.axes, box.rotation.T) < 0.05


@pytest.mark.parametrize("yaw", [0.0, 0.4, 1.1, -0.9])
def test_normals_give_the_axes_of_a_cube_and_eigenvectors_do_not(yaw: float) -> None:
    box = some_box([0, 0, 3], [0.2, yaw, 0.1], [0.5, 0.5, 0.5])
    xyz = box_surface(box, 3000, np.random.default_rng(0)).astype(np.float32)
    cloud = PointCloud(xyz, normals=normals_knn(xyz))
    found = find_axes(cloud, Strategy.NORMALS, np.eye(3), None, FREE)
    assert found.strategy is Strategy.NORMALS and found.fallback == ()
    assert axes_angle_rad(found.axes, box.rotation.T) < 0.08
    assert (
        find_axes(cloud, Strategy.EIGENVECTORS, np.eye(3), None, RcvConfig(orientation=Orientation.FREE)).strategy
        is Strategy.CAMERA
    )
