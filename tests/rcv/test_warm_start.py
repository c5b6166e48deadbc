"""Warm starts, the first look of a class-agnostic detector, whole boxes of objects drawn as seen, following."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scenes import CAMERA, Counting, box_surface, frame_with, some_box
from scipy.spatial.transform import Rotation

from annotator.detection.perfect import PerfectDetector
from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import aligned_box, contains
from annotator.geometry.outline import box_on_image, points_on_image
from annotator.geometry.projection import project
from annotator.rcv.config import AGNOSTIC_LABELS, Orientation, RcvConfig, Strategy
from annotator.rcv.follow_object import Followed, FollowStop, Look, follow_object
from annotator.rcv.propose import propose, propose_from_boxes
from annotator.rcv.starts import WARM_START, WarmStart, is_warm, match_warm_starts
from annotator.rcv.whole_box import Offered, SeenObject, whole_boxes
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind, Detector, Frame, Image, OrientedBox, PointCloud, Proposal
from annotator.workflows.detectors import Detectors
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.workbench.review_queue import doubt

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


CONFIG = RcvConfig().for_detector(BoxKind.BOX, class_agnostic=True)
CENTER = np.array([0.1, 0.0, 1.5])


def bumpy(count: int = 12_000) -> tuple[np.ndarray, np.ndarray]:
    """Points on a closed surface without symmetries, and their normals: a body with a thicker part."""
    rng = np.random.default_rng(0)
    around, height = rng.uniform(-np.pi, np.pi, count), rng.uniform(-1, 1, count)
    flat = np.sqrt(1 - height**2)
    unit = np.stack([flat * np.cos(around), height, flat * np.sin(around)], axis=1)
    size = np.array([0.12, 0.35, 0.22]) * (1 + 0.25 * np.exp(-8 * ((unit - [0.5, 0.6, 0.6]) ** 2).sum(axis=1)))[:, None]
    normals = unit / size
    return unit * size, normals / np.linalg.norm(normals, axis=1, keepdims=True)


POINTS, NORMALS = bumpy()


def shown(angle_rad: float) -> tuple[Frame, OrientedBox]:
    """A frame with what is seen of the body after a turn about the vertical, in front of a wall; and its true box."""
    turn = Rotation.from_rotvec(angle_rad * UP).as_matrix()
    xyz, normals = POINTS @ turn.T + CENTER, NORMALS @ turn.T
    rays = xyz / np.linalg.norm(xyz, axis=1, keepdims=True)
    seen = xyz[(normals * rays).sum(axis=1) < -0.1]
    u, v = np.meshgrid(np.linspace(-0.6, 0.6, 160), np.linspace(-0.45, 0.45, 120))
    wall = np.stack([3 * u.ravel(), 3 * v.ravel(), np.full(u.size, 3.0)], axis=1)
    cloud = PointCloud(np.concatenate([seen, wall]).astype(np.float32))
    frame = Frame("0", 0, CAMERA, np.zeros((480, 640, 3), np.uint8), cloud, up=UP)
    return frame, aligned_box(xyz, turn)


def drawn(frame: Frame) -> tuple[SeenObject, np.ndarray]:
    """The body as an operator draws it, and the mask of its points."""
    mask = frame.cloud.xyz_m[:, 2] < 2.5
    image_box = points_on_image(CAMERA, frame.cloud.xyz_m[mask], "body")
    assert image_box is not None
    axes = np.stack([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    return SeenObject.of(frame, mask, image_box, axes.T, UP), mask


def offered(angles_rad: Sequence[float], view: Any = None) -> tuple[list[Offered], SeenObject, OrientedBox]:
    """What is offered for the first of several frames; the others follow it."""
    frames = [shown(angle) for angle in angles_rad]
    objects = [drawn(frame) for frame, _ in frames]
    seen, mask = objects[0]
    after = [[other] for other, _ in objects[1:]]
    return whole_boxes(seen, frames[0][0].cloud.select(mask), [], after, view, CONFIG), seen, frames[0][1]


def test_an_object_that_turned_around_has_the_box_of_all_its_sides() -> None:
    (found,), seen, truth = offered(np.arange(0, 2 * np.pi, np.pi / 9).tolist())
    assert found.is_closed
    assert iou_3d(found.box, truth) > 0.85
    assert iou_3d(found.box, truth) > iou_3d(aligned_box(seen.xyz_m, np.eye(3)), truth) + 0.2


def test_without_other_sides_the_box_is_not_smaller_than_what_is_seen() -> None:
    found, seen, _ = offered([0.3])
    assert 1 <= len(found) <= 2 and not any(one.is_closed for one in found)
    for one in found:
        assert contains(one.box, seen.xyz_m, 1e-6).all()
    np.testing.assert_allclose(np.sort(found[0].box.size_m), np.sort(np.ptp(seen.xyz_m, axis=0)), atol=1e-6)


class Ends:
    """A class-agnostic detector that ends the whole object at the same share of each view."""

    labels, fingerprint = ("whole", "seen"), "ends"

    def __init__(self, low: float, high: float) -> None:
        self.low, self.high = low, high

    def detect(self, images: Sequence[Any]) -> list[list[Box2D]]:
        found = []
        for image in images:
            height, width = image.rgb.shape[:2]
            ends = (self.low * width, self.low * height, self.high * width, self.high * height)
            found.append([Box2D("whole", *ends, score=0.9)])
        return found


@pytest.mark.parametrize("detector", [Ends(-0.5, 1.5), Ends(0.4, 0.6)], ids=["too large", "too small"])
def test_a_detector_extends_the_drawn_box_away_from_the_camera_only(detector: Ends) -> None:
    (first, *_), seen, _ = offered([0.3], detector)
    half = np.abs(first.box.rotation) @ first.box.size_m / 2
    low, high = first.box.center_m - half, first.box.center_m + half
    np.testing.assert_allclose(low[2], seen.xyz_m[:, 2].min(), atol=1e-6)
    is_deeper = high[2] > seen.xyz_m[:, 2].max() + 0.05
    assert is_deeper == (detector.high > 1)
    assert (low <= seen.xyz_m.min(axis=0) + 1e-6).all() and (high >= seen.xyz_m.max(axis=0) - 1e-6).all()


def test_another_object_is_not_followed() -> None:
    frame, _ = shown(0.0)
    seen, mask = drawn(frame)
    rng = np.random.default_rng(1)
    ball = rng.normal(size=(3000, 3))
    ball = 0.06 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + CENTER
    near = Frame("1", 1, CAMERA, frame.rgb, PointCloud(ball[ball[:, 2] < CENTER[2]].astype(np.float32)), up=UP)
    other = SeenObject.of(near, np.ones(len(near.cloud), np.bool_), seen.image_box, np.eye(3), UP)
    alone = whole_boxes(seen, frame.cloud.select(mask), [], [], None, CONFIG)
    both = whole_boxes(seen, frame.cloud.select(mask), [], [[other]], None, CONFIG)
    assert [one.is_closed for one in both] == [one.is_closed for one in alone]
    assert all(iou_3d(a.box, b.box) > 0.99 for a, b in zip(alone, both, strict=True))


def of_points(xyz_m: np.ndarray, up: np.ndarray | None = UP) -> list[Offered]:
    """What is offered for an object of which one frame shows these points."""
    cloud = PointCloud(xyz_m.astype(np.float32))
    frame = Frame("0", 0, CAMERA, np.zeros((480, 640, 3), np.uint8), cloud, up=UP)
    u, v = project(CAMERA, xyz_m).T
    box = Box2D("body", *(float(each) for each in (u.min() - 1, v.min() - 1, u.max() + 1, v.max() + 1)))
    seen = SeenObject.of(frame, np.ones(len(cloud), np.bool_), box, np.eye(3), up)
    return whole_boxes(seen, cloud, [], [], None, CONFIG)


@pytest.mark.parametrize("noise_m", [0.0, 0.002])
@pytest.mark.parametrize("up", [UP, None], ids=["upright", "free"])
def test_a_table_top_seen_from_above_is_not_seen_from_all_around(noise_m: float, up: np.ndarray | None) -> None:
    x, z = np.meshgrid(np.linspace(-0.6, 0.6, 80), np.linspace(1.6, 2.4, 54))
    y = 0.6 + np.random.default_rng(0).normal(0, 1, x.size) * noise_m
    found = of_points(np.stack([x.ravel(), y, z.ravel()], axis=1), up)
    assert found and not any(one.is_closed for one in found)


@pytest.mark.parametrize("count", [1, 2, 5, 300])
def test_nothing_is_offered_for_a_few_points_or_points_on_a_line(count: int) -> None:
    line = np.linspace(0, 1, count)[:, None] * [0.3, 0.2, 0.5] + CENTER
    assert of_points(line) == []
    assert of_points(line, None) == []
    assert of_points(np.tile(CENTER, (count, 1))) == []


UPRIGHT = RcvConfig(orientation=Orientation.UPRIGHT)
# From this doubt on, `benchmarks.follow` counts a box as marked.
MARKED = 0.8


def frame_of(*parts: np.ndarray) -> Frame:
    xyz = np.concatenate(parts).astype(np.float32)
    image = np.zeros((480, 640, 3), np.uint8)
    return Frame("000000", 0, CAMERA, image, PointCloud(xyz, np.full((len(xyz), 3), 99, np.uint8)), up=UP)


def seen(box: OrientedBox, seed: int = 0, points: int = 6000) -> np.ndarray:
    """Points on the sides of an upright box that face the camera, fewer on those seen at a flat angle."""
    rng = np.random.default_rng(seed)
    xyz = box_surface(box, points, rng)
    local = (xyz - box.center_m) @ box.rotation / box.size_m
    axis = np.argmax(np.abs(local), axis=1)
    normal = box.rotation.T[axis] * np.sign(local[np.arange(len(local)), axis])[:, None]
    facing = -(normal * xyz).sum(axis=1) / np.linalg.norm(xyz, axis=1)
    return np.asarray(xyz[facing > rng.random(len(xyz))])


def turned(box: OrientedBox, angle_rad: float, shift: Sequence[float] = (0.0, 0.0, 0.0)) -> OrientedBox:
    turn = Rotation.from_rotvec(angle_rad * UP).as_matrix()
    return OrientedBox.from_parts(box.center_m + np.array(shift), turn @ box.rotation, box.size_m)


THING = turned(some_box([0.2, 0.1, 3.0], [np.pi / 2, 0.0, 0.0], [0.8, 0.5, 1.2]), 0.4)


def follow(frames: Sequence[Frame], start: OrientedBox = THING) -> list[Followed]:
    """Follows a box from the first frame on, up to the first frame without it."""
    reviewed = last = Look.of(frames[0].cloud.xyz_m, start)
    results = []
    for frame in frames[1:]:
        followed = follow_object(frame, last.box, reviewed, last, "thing", None, UPRIGHT)
        results.append(followed)
        if followed.proposal is None:
            break
        last = Look.of(frame.cloud.xyz_m, followed.proposal.box, followed.kept)
    return results


def marked(followed: Followed) -> bool:
    assert followed.proposal is not None
    value = doubt(followed.proposal.quality, followed.proposal.score)
    assert value is not None
    return value >= MARKED


def test_a_moving_and_turning_object_keeps_its_size() -> None:
    boxes = [turned(THING, 0.05 * k, [0.03 * k, 0.0, 0.05 * k]) for k in range(10)]
    results = follow([frame_of(seen(box, k)) for k, box in enumerate(boxes)])
    assert len(results) == 9
    for followed, box in zip(results, boxes[1:], strict=True):
        assert followed.proposal is not None
        assert iou_3d(followed.proposal.box, box) > 0.6
        np.testing.assert_array_equal(followed.proposal.box.size_m, THING.size_m)
        assert not marked(followed)


def test_an_object_that_turns_its_other_side_is_not_lost() -> None:
    boxes = [turned(THING, 0.09 * k) for k in range(30)]
    results = follow([frame_of(seen(box, k)) for k, box in enumerate(boxes)])
    last = results[-1].proposal
    assert len(results) == 29
    assert last is not None
    assert iou_3d(last.box, boxes[-1]) > 0.4


def test_an_object_that_jumps_further_than_registration_reaches_is_found() -> None:
    moved = turned(THING, 0.1, [0.4, -0.2, 0.1])
    (followed,) = follow([frame_of(seen(THING)), frame_of(seen(moved, 1))])
    assert followed.proposal is not None
    assert iou_3d(followed.proposal.box, moved) > 0.6


def test_neighbours_are_not_confused_with_the_object() -> None:
    neighbour = turned(THING, -0.2, [0.95, 0.0, 0.2])
    boxes = [turned(THING, 0.0, [0.02 * k, 0.0, 0.0]) for k in range(8)]
    results = follow([frame_of(seen(box, k), seen(neighbour, 50 + k)) for k, box in enumerate(boxes)])
    assert results[-1].proposal is not None
    assert iou_3d(results[-1].proposal.box, boxes[-1]) > 0.8


def test_a_box_that_loses_its_object_is_marked_and_then_lost() -> None:
    """The object disappears from above, and the bar that it touches stays."""
    bar = box_surface(some_box([1.0, 0.4, 3.0], [0.0, 0.0, 0.0], [2.4, 0.3, 0.3]), 400, np.random.default_rng(1))
    frames = []
    for k in range(20):
        points = seen(THING, k)
        frames.append(frame_of(bar, points[points[:, 1] > THING.center_m[1] - 0.6 + 0.06 * k]))
    results = follow(frames)
    assert results[-1].proposal is None
    assert results[-1].stop in (FollowStop.CHANGED, FollowStop.POINTS)
    assert not marked(results[0])
    assert marked(results[-2])


def test_what_is_not_there_is_not_followed() -> None:
    first, elsewhere = frame_of(seen(THING)), frame_of(seen(turned(THING, 0.0, [0.0, 0.0, 9.0])))
    assert follow([first, elsewhere])[0].stop is FollowStop.POINTS
    behind = turned(THING, 0.0, [0.0, 0.0, -9.0])
    (result,) = follow([frame_of(seen(THING), seen(behind)), first], behind)
    assert result.stop is FollowStop.LEFT


class Measures:
    """A view detector that sees every object larger than its points by a factor."""

    labels, fingerprint = ("thing",), "measures"

    def __init__(self, factor: float) -> None:
        self.factor = factor

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        return [[self._around(image.rgb)] for image in images]

    def _around(self, rgb: np.ndarray) -> Box2D:
        rows, columns = np.nonzero((rgb != rgb[0, 0]).any(axis=2))
        middle = np.array([columns.min() + columns.max(), rows.min() + rows.max()]) / 2
        half = self.factor * np.array([np.ptp(columns), np.ptp(rows)]) / 2
        return Box2D("thing", *(middle - half).tolist(), *(middle + half).tolist(), 0.9)


@pytest.mark.parametrize(("factor", "is_taken"), [(1.0, True), (0.3, False)])
def test_a_measured_box_is_taken_if_it_agrees(factor: float, is_taken: bool) -> None:
    whole = [box_surface(box, 3000, np.random.default_rng(k)) for k, box in enumerate((THING, turned(THING, 0.05)))]
    reviewed = Look.of(whole[0], THING)
    followed = follow_object(frame_of(whole[1]), THING, reviewed, reviewed, "thing", Measures(factor), UPRIGHT)
    assert followed.proposal is not None
    assert bool(followed.proposal.trace) is is_taken
    assert iou_3d(followed.proposal.box, turned(THING, 0.05)) > 0.7
    # its axes are those of the reviewed box
    assert np.trace(followed.proposal.box.rotation.T @ THING.rotation) > 2.9
