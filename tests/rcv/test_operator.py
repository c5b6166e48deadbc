"""The labelling procedure: five boxes per object, which select the object's points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scenes import CAMERA, frame_with, some_box

from annotator.detection.perfect import PerfectDetector
from annotator.rcv.config import Orientation, RcvConfig, Strategy
from annotator.rcv.known_objects import LABELLED_STEPS, DrawnObject, cut_out, draw_object, first_views, next_views
from annotator.rcv.propose import propose_from_boxes
from annotator.rcv.teach import project_box
from annotator.types import Box2D, Frame, Image, PseudoView

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


def spans(found: DrawnObject) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(item.view.axes, item.view.interval_m(item.box)) for item in found.views]


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


def test_the_first_views_are_along_the_camera_axes_and_show_the_whole_frustum() -> None:
    frame, _ = frame_with([BOX], up=UP)
    views = first_views(frame, image_box(frame), CONFIG)
    assert views is not None
    np.testing.assert_allclose(views[0].axes, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(views[1].axes, [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], atol=1e-12)
    shown = {tuple(point) for point in views[0].xyz_m}
    assert all(tuple(point) in shown for point in frame.cloud.xyz_m[OBJECT])
    assert len(shown) > 800, "the wall behind the object is also in its frustum"


@pytest.mark.parametrize("orientation", list(Orientation))
def test_the_second_step_shows_only_the_object(orientation: Orientation) -> None:
    frame, _ = frame_with([BOX], up=UP)
    config = RcvConfig(orientation=orientation)
    views = next_views(frame, image_box(frame), spans(drawn(frame, config))[:2], config)
    assert views is not None
    shown = {tuple(point) for point in views[0].xyz_m}
    mine = sum(tuple(point) in shown for point in frame.cloud.xyz_m[OBJECT])
    assert mine >= 795
    assert len(shown) == mine, "the wall has been cut away"
    if orientation is Orientation.UPRIGHT:
        np.testing.assert_allclose(views[0].axes[1], -UP, atol=1e-9)


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


def test_a_box_cut_off_by_the_picture_gets_a_larger_margin_in_the_second_step() -> None:
    frame, _ = frame_with([BOX], up=UP)
    shown = [(item.view, item.view.interval_m(item.box)) for item in drawn(frame).views[:2]]
    (front, front_span), (side, side_span) = shown
    cut = front_span.copy()
    cut[0, 0] = front.origin_m[0] - 0.5 * front.metres_per_px  # the left edge of the picture
    extents = []
    for span in (front_span, cut):
        for room in (1.0, 2.0):
            config = CONFIG.model_copy(update={"cut_room": room})
            views = next_views(frame, image_box(frame), [(front.axes, span), (side.axes, side_span)], config)
            assert views is not None
            extents.append(views[0].extent_m.max())
    assert extents[0] == extents[1]
    assert extents[3] > 1.3 * extents[2]


def test_the_drawn_boxes_select_the_objects_points() -> None:
    frame, _ = frame_with([BOX, some_box([0.9, 0, 2.0], [0, 0.2, 0], [0.4, 0.5, 0.3])], up=UP)
    mask = cut_out(frame, image_box(frame), [(span, 1e-3) for span in spans(drawn(frame))])
    assert mask.shape == (len(frame.cloud),)
    assert mask[OBJECT].mean() > 0.99
    assert not mask[800:].any()


@pytest.mark.parametrize("unseen", [0, 1, 2, 3])
def test_an_object_that_is_missing_in_one_view_is_not_finished(unseen: int) -> None:
    frame, _ = frame_with([BOX], up=UP)
    asked: list[PseudoView] = []

    def draw(view: PseudoView) -> Box2D | None:
        asked.append(view)
        return None if len(asked) == unseen + 1 else project_box(view, BOX, "thing")

    assert draw_object(frame, image_box(frame), draw, CONFIG) is None
    assert len(asked) == (2 if unseen < 2 else 4), "both views of the step are shown, and no later view"


def test_a_frustum_or_crop_with_too_few_points_ends_the_procedure() -> None:
    frame, _ = frame_with([BOX], up=UP)
    corner = Box2D("thing", -0.5, -0.5, 1.0, 1.0)
    assert first_views(frame, corner, CONFIG) is None
    assert draw_object(frame, corner, lambda view: project_box(view, BOX, "thing"), CONFIG) is None
    nowhere = [(axes, span + 50.0) for axes, span in spans(drawn(frame))[:2]]
    assert next_views(frame, image_box(frame), nowhere, CONFIG) is None
