"""Whole boxes of objects that were drawn as they are seen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from scenes import CAMERA
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import aligned_box, contains
from annotator.geometry.outline import points_on_image
from annotator.geometry.projection import project
from annotator.rcv.config import RcvConfig
from annotator.rcv.whole_box import Offered, SeenObject, whole_boxes
from annotator.types import Box2D, BoxKind, Frame, OrientedBox, PointCloud

UP = np.array([0.0, -1.0, 0.0])
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
