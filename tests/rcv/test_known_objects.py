"""2D boxes of known 3D boxes on views: its own object's first; pseudo-views to train on, labelled by them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA, frame_with, some_box

from annotator.detection.perfect import PerfectDetector
from annotator.geometry.oriented_box import box_corners, contains
from annotator.rcv import teach
from annotator.rcv.config import Orientation, RcvConfig, Strategy
from annotator.rcv.known_objects import LABELLED_STEPS, DrawnObject, KnownFrame, boxes_of_known, draw_object, next_views
from annotator.rcv.propose import propose_from_boxes
from annotator.rcv.teach import TaughtObject, TaughtView, project_box, teach_views
from annotator.types import Box2D, BoxKind, Frame, Image, OrientedBox, PseudoView, Truth

UP = np.array([0.0, -1.0, 0.0])
BOX = some_box([-0.3, 0.1, 2.2], [0, 0.5, 0], [0.6, 0.8, 0.3])
CONFIG = RcvConfig(orientation=Orientation.UPRIGHT)
OBJECT = slice(0, 800)


def image_box(frame: Frame, margin_px: float = 0.0) -> Box2D:
    """The box around the first object's 800 points, by the pinhole formula."""
    xyz = frame.cloud.xyz_m[OBJECT].astype(float)
    u = CAMERA.fx * xyz[:, 0] / xyz[:, 2] + CAMERA.cx
    v = CAMERA.fy * xyz[:, 1] / xyz[:, 2] + CAMERA.cy
    return Box2D("thing", u.min() - margin_px, v.min() - margin_px, u.max() + margin_px, v.max() + margin_px)


def drawn(frame: Frame, config: RcvConfig = CONFIG) -> DrawnObject:
    found = draw_object(frame, image_box(frame), lambda view: project_box(view, BOX, "thing"), config)
    assert found is not None
    return found


def test_an_object_needs_a_front_and_a_side_box_in_each_of_two_steps() -> None:
    frame, _ = frame_with([BOX], up=UP)
    found = drawn(frame)
    assert [item.step for item in found.views] == [0, 0, 1, 1]
    assert LABELLED_STEPS == 2
    assert found.image_box == image_box(frame)
    for front, side in (found.views[:2], found.views[2:]):
        # the two views are orthogonal and share the axis that points down
        np.testing.assert_allclose(front.view.axes @ front.view.axes.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(side.view.axes[0], front.view.axes[2], atol=1e-12)
        np.testing.assert_allclose(side.view.axes[1], front.view.axes[1], atol=1e-12)
        assert np.linalg.det(side.view.axes) == pytest.approx(1)


def test_the_second_step_shows_the_same_views_as_the_recursion() -> None:
    """Otherwise the detector would be trained on tighter crops than it gets in the recursion."""
    frame, truths = frame_with([BOX], up=UP)
    config = CONFIG.model_copy(update={"strategy": Strategy.NORMALS, "max_steps": 2})
    detector = PerfectDetector.for_frame(frame, truths)
    seen: list[PseudoView] = []

    class Watching:
        labels, fingerprint = detector.labels, detector.fingerprint

        def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
            seen.extend(image for image in images if isinstance(image, PseudoView))
            return detector.detect(images)

    propose_from_boxes([frame], [[image_box(frame)]], Watching(), config)
    first = [(view.axes, view.interval_m(detector.detect([view])[0][0])) for view in seen[:2]]
    views = next_views(frame, image_box(frame), first, config)
    assert views is not None
    for drawn_on, met in zip(views, seen[2:], strict=True):
        np.testing.assert_allclose(drawn_on.axes, met.axes, atol=1e-6)
        np.testing.assert_allclose(drawn_on.origin_m, met.origin_m, atol=1e-6)
        np.testing.assert_array_equal(drawn_on.xyz_m, met.xyz_m)


NEAR = some_box([-0.1, 0.1, 2.2], [0, 0.5, 0], [0.6, 0.8, 0.3])
BESIDE = some_box([0.35, 0.0, 2.9], [0, -0.3, 0], [0.5, 0.9, 0.4])


def known(*boxes: OrientedBox, unmeasured: tuple[OrientedBox, ...] = ()) -> tuple[KnownFrame, Frame]:
    """The 2D boxes of a frame with objects a, b, ...; those in `unmeasured` have no points."""
    frame, truths = frame_with([*boxes], up=UP)
    named = [replace(t, label="abc"[k]) for k, t in enumerate([*truths, *(Truth("", box) for box in unmeasured)])]
    return boxes_of_known(frame, named, CONFIG), frame


def on_view(view: PseudoView, box: OrientedBox) -> np.ndarray:
    """The extent of a box on a view, (x_min, y_min, x_max, y_max), clipped to the picture."""
    px = (box_corners(box) @ view.axes[:2].T - view.origin_m) / view.metres_per_px
    height_px, width_px = view.rgb.shape[:2]
    last = np.array([width_px, height_px]) - 0.5
    return np.concatenate([px.min(axis=0).clip(-0.5, last), px.max(axis=0).clip(-0.5, last)])


def test_a_view_has_the_boxes_of_all_visible_objects() -> None:
    found, frame = known(NEAR, BESIDE)
    boxes = {"a": NEAR, "b": BESIDE}
    total = {name: contains(box, frame.cloud.xyz_m).sum() for name, box in boxes.items()}
    assert [item.image_box.label for item in found.objects] == ["a", "b"]
    assert found.on_image == tuple(item.image_box for item in found.objects)
    numbers = []
    for item in found.objects:
        own = item.image_box.label
        assert [view.step for view in item.views] == [0, 0, 1, 1]
        for view in item.views:
            drawn = {name: contains(box, view.view.xyz_m).sum() for name, box in boxes.items()}
            shown = {name for name in boxes if drawn[name] >= max(5, 0.3 * total[name])}
            labels = [box.label for box in view.boxes]
            assert labels[0] == own
            assert set(labels) == shown
            assert len(labels) == len(shown)
            for box in view.boxes:
                np.testing.assert_allclose(box.xyxy, on_view(view.view, boxes[box.label]), atol=1e-6)
            numbers.append(len(labels))
    # the neighbour is in the near object's frustum, but no longer in its second step
    assert numbers == [2, 2, 1, 1, 1, 1, 1, 1]


def test_invisible_objects_are_reported_and_have_no_box() -> None:
    behind_the_wall, beside_the_picture = (
        some_box([0, 0, 5], [0, 0, 0], [1, 1, 1]),
        some_box([9, 0, 3], [0, 0, 0], [1] * 3),
    )
    found, _ = known(NEAR, unmeasured=(behind_the_wall, beside_the_picture))
    assert (found.hidden, found.outside, found.without_views) == (("b",), ("c",), ())
    assert [box.label for box in found.on_image] == ["a"]


def test_an_unoccluded_object_without_points_is_on_the_image_only() -> None:
    """The wall behind it was measured, as through glass, so the image may show the object."""
    found, _ = known(NEAR, unmeasured=(some_box([0.9, 0, 3], [0, 0, 0], [0.5] * 3),))
    assert [box.label for box in found.on_image] == ["a", "b"]
    assert [item.image_box.label for item in found.objects] == ["a"]
    assert (found.hidden, found.outside, found.without_views) == ((), (), ("b",))


BOXES = [
    some_box([-0.25, 0.1, 2.0], [0, 0.5, 0], [0.6, 0.8, 0.3]),
    some_box([0.35, 0.0, 2.2], [0, -0.3, 0], [0.4, 0.5, 0.3]),
]
TAUGHT = RcvConfig(view_px=96)


def corners_of(box: OrientedBox) -> np.ndarray:
    """The 8 corners by hand: centre + R (signs * size / 2)."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    matrix = box.pose
    return (signs * box.size_m / 2) @ matrix[:3, :3].T + matrix[:3, 3]


def on_picture(view: PseudoView, xyz_m: np.ndarray) -> np.ndarray:
    """(n, 2) pixels of points, as dot products with the view's x and y axes."""
    return np.stack([xyz_m @ view.axes[0] - view.origin_m[0], xyz_m @ view.axes[1] - view.origin_m[1]], 1) / (
        view.metres_per_px
    )


def clipped(view: PseudoView, px: np.ndarray) -> tuple[float, ...]:
    height_px, width_px = view.rgb.shape[:2]
    limit = np.array([width_px, height_px]) - 0.5
    return (*np.clip(px.min(axis=0), -0.5, limit), *np.clip(px.max(axis=0), -0.5, limit))


def taught(
    frame: Frame, objects: list[TaughtObject], kind: BoxKind = BoxKind.BOX, **changes: object
) -> list[TaughtView]:
    chosen = {"draws": 12, "up": UP, "seed": 3, **changes}
    rng = np.random.default_rng(chosen["seed"])
    return teach_views(frame, objects, kind, chosen["draws"], TAUGHT, chosen["up"], rng)


def two() -> tuple[Frame, list[TaughtObject]]:
    """Two objects of different classes in front of a wall."""
    frame, truths = frame_with(BOXES, up=UP)
    return frame, [TaughtObject(name, t.box) for name, t in zip(("left", "right"), truths, strict=True)]


def test_boxes_are_the_projected_true_boxes() -> None:
    frame, objects = two()
    views = taught(frame, objects)
    by_name = {item.label: item.box for item in objects}
    assert sum(len(item.boxes) for item in views) > 20
    for item in views:
        for box in item.boxes:
            assert box.xyxy == pytest.approx(clipped(item.view, on_picture(item.view, corners_of(by_name[box.label]))))


def test_silhouettes_contain_the_objects_drawn_points() -> None:
    frame, objects = two()
    views = taught(frame, objects, BoxKind.SILHOUETTE)
    numbers = {tuple(point): number // 800 for number, point in enumerate(frame.cloud.xyz_m[:1600])}
    names = [item.label for item in objects]
    assert sum(len(item.boxes) for item in views) > 20
    for item in views:
        owner = np.array([numbers.get(tuple(point), -1) for point in item.view.xyz_m])
        for box in item.boxes:
            # the scene's points lie exactly on the box's faces; rounding puts some of them outside
            inside = contains(BOXES[names.index(box.label)], item.view.xyz_m)
            own = item.view.xyz_m[(owner == names.index(box.label)) & inside]
            assert box.xyxy == pytest.approx(clipped(item.view, on_picture(item.view, own.astype(float))), abs=1e-3)


def test_neighbours_in_a_crop_are_labelled_too() -> None:
    # a small object in the corner of the crop of a rotated one
    frame, truths = frame_with([BOXES[0], some_box([0.02, 0.1, 2.2], [0, 0.2, 0], [0.12, 0.3, 0.12])], up=UP)
    objects = [TaughtObject(name, t.box) for name, t in zip(("left", "right"), truths, strict=True)]
    together = [item for item in taught(frame, objects, draws=30) if len(item.boxes) == 2]
    assert len(together) > 10
    assert {box.label for item in together for box in item.boxes} == {"left", "right"}


def test_an_object_with_few_points_is_left_out() -> None:
    frame, _ = frame_with(BOXES[:1], up=UP)
    empty = some_box([0.9, -0.6, 1.5], [0, 0, 0], [0.1, 0.1, 0.1])
    assert contains(empty, frame.cloud.xyz_m).sum() < teach.MIN_POINTS
    assert taught(frame, [TaughtObject("ghost", empty)]) == []
    views = taught(frame, [TaughtObject("left", BOXES[0]), TaughtObject("ghost", empty)])
    assert {box.label for item in views for box in item.boxes} == {"left"}
    few = np.zeros(len(frame.cloud), bool)
    few[: teach.MIN_POINTS - 1] = True
    assert taught(frame, [TaughtObject("left", BOXES[0], few)]) == []


def test_views_that_show_a_doubtful_object_are_left_out() -> None:
    """Only the left half of an object is known; the rest may belong to another object."""
    frame, (left, _) = two()
    shift = left.box.rotation @ (left.box.size_m * [0.25, 0, 0])
    half = OrientedBox.from_parts(left.box.center_m - shift, left.box.rotation, left.box.size_m * [0.5, 1, 1])
    known = [TaughtObject("left", half)]

    def draws(doubtful: list[OrientedBox]) -> int:
        return len(teach_views(frame, known, BoxKind.BOX, 40, TAUGHT, UP, np.random.default_rng(3), doubtful))

    assert draws([]) > 40
    assert draws([left.box]) < draws([]) - 10
    assert draws([half]) == draws([]), "a proposal of the known object itself has no effect"
