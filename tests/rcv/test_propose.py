"""The whole recursion with a perfect detector, the axes of strategies, and typical sizes of classes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from scenes import Counting, box_surface, frame_with, some_box
from test_warm_start import AnyClass

from annotator.detection.perfect import PerfectDetector, Scene
from annotator.geometry.iou import iou_3d
from annotator.geometry.normals import normals_knn
from annotator.geometry.oriented_box import box_corners, contains
from annotator.geometry.outline import box_on_image
from annotator.rcv import pseudo_view
from annotator.rcv.axes import axes_angle_rad, find_axes
from annotator.rcv.config import AGNOSTIC_LABELS, Orientation, RcvConfig, Strategy, TypicalSize, typical_size
from annotator.rcv.first_look import Outline
from annotator.rcv.propose import propose, propose_from_boxes
from annotator.rcv.starts import NOT_SEEN, TYPICAL_SIZE
from annotator.rcv.typical_size import BY_SCORE, Candidates, Evidence, place
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind, Camera, Detector, Frame, Image, OrientedBox, PointCloud, StopReason, Truth
from annotator.workflows.detectors import Detectors
from annotator.workflows.recorded.reading import load_truth

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


CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
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


def frame_of_size(*boxes: OrientedBox) -> Frame:
    xyz = np.concatenate([surface(box) for box in boxes])
    rgb = np.zeros((CAMERA.height_px, CAMERA.width_px, 3), np.uint8)
    return Frame("000000", 0, CAMERA, rgb, PointCloud(xyz, np.full((len(xyz), 3), 128, np.uint8)), up=UP)


def config_for(*sizes: TypicalSize, use: bool = True) -> RcvConfig:
    config = RcvConfig(orientation=Orientation.UPRIGHT, typical_sizes=sizes, use_typical_sizes=use)
    return config.for_detector(BoxKind.BOX, class_agnostic=True)


def test_an_object_of_typical_size_needs_no_detection() -> None:
    frame, image_box = frame_of_size(BOX), box_on_image(CAMERA, BOX, "crate")
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
    frame = frame_of_size(BOX)
    box, notes = boxed(frame, seeing(frame) if sees else Blind(), start_config(orientation, trained))
    assert iou_3d(box, BOX) > (0.85 if sees else 0.4)
    assert (NOT_SEEN in notes) == (trained and not sees)
    assert TYPICAL_SIZE in notes


def test_a_box_that_does_not_agree_with_the_image_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pseudo_view, "DEEP", 100.0)
    frame = frame_of_size(BOX)
    half = OrientedBox(BOX.pose, BOX.size_m * 0.4)
    wrong = PerfectDetector.for_frame(frame, [Truth(AGNOSTIC_LABELS[BoxKind.BOX], half)])
    assert NOT_SEEN in boxed(frame, wrong, start_config(Orientation.FREE, True))[1]
