"""2D boxes of known 3D boxes: each view has a box for every visible object, its own object's first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA, frame_with, some_box

from annotator.geometry.oriented_box import box_corners, contains
from annotator.rcv.config import Orientation, RcvConfig
from annotator.rcv.known_objects import KnownFrame, boxes_of_known
from annotator.types import Frame, OrientedBox, PseudoView, Truth

UP = np.array([0.0, -1.0, 0.0])
CONFIG = RcvConfig(orientation=Orientation.UPRIGHT)
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


def test_image_boxes_are_clipped_and_include_the_occluded_part() -> None:
    """The second object extends beyond the image; the third is half occluded by the first."""
    out, covered = (
        some_box([1.5, 0.0, 2.4], [0, 0, 0], [0.8, 0.6, 0.4]),
        some_box([-0.3, 0.1, 3.2], [0, 0, 0], [1.0, 0.6, 0.4]),
    )
    found, _ = known(NEAR, out, covered)
    _, cut, whole = found.on_image
    near_m = 2.4 - 0.2
    assert cut.x_max == CAMERA.width_px - 0.5
    assert cut.x_min == pytest.approx(CAMERA.cx + CAMERA.fx * (1.5 - 0.4) / (2.4 + 0.2), abs=1e-6)
    assert cut.y_max == pytest.approx(CAMERA.cy + CAMERA.fy * 0.3 / near_m, abs=1e-6)
    front_m = 3.2 - 0.2
    expected = [CAMERA.fx * (-0.3 - 0.5) / front_m, CAMERA.fy * (0.1 - 0.3) / front_m]
    assert [whole.x_min - CAMERA.cx, whole.y_min - CAMERA.cy] == pytest.approx(expected, abs=1e-6)


def test_too_few_points_give_no_views() -> None:
    frame, (truth, other) = frame_with([NEAR, BESIDE], up=UP)
    few = np.ones(len(frame.cloud), bool)
    few[800 + 4 : 1600] = False
    found = boxes_of_known(replace(frame, cloud=frame.cloud.select(few)), [truth, replace(other, label="b")], CONFIG)
    assert [box.label for box in found.on_image] == ["thing", "b"]
    assert [item.image_box.label for item in found.objects] == ["thing"]
    assert found.without_views == ("b",)
