"""2D boxes of known 3D boxes: each view has a box for every visible object, its own object's first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA, frame_with, some_box

from annotator.detection.perfect import PerfectDetector
from annotator.geometry.oriented_box import box_corners, contains
from annotator.rcv.config import Orientation, RcvConfig, Strategy
from annotator.rcv.known_objects import LABELLED_STEPS, DrawnObject, KnownFrame, boxes_of_known, draw_object, next_views
from annotator.rcv.propose import propose_from_boxes
from annotator.rcv.teach import project_box
from annotator.types import Box2D, Frame, Image, OrientedBox, PseudoView, Truth

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
