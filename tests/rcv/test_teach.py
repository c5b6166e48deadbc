"""Pseudo-views labelled by known 3D boxes: each 2D box is the extent of its object, and results are reproducible."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import frame_with, some_box

from annotator.geometry.oriented_box import contains
from annotator.rcv import teach
from annotator.rcv.config import RcvConfig
from annotator.rcv.teach import TaughtObject, TaughtView, teach_views
from annotator.types import BoxKind, Frame, OrientedBox, PseudoView

UP = np.array([0.0, -1.0, 0.0])
BOXES = [
    some_box([-0.25, 0.1, 2.0], [0, 0.5, 0], [0.6, 0.8, 0.3]),
    some_box([0.35, 0.0, 2.2], [0, -0.3, 0], [0.4, 0.5, 0.3]),
]
CONFIG = RcvConfig(view_px=96)


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
    return teach_views(frame, objects, kind, chosen["draws"], CONFIG, chosen["up"], rng)


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
        return len(teach_views(frame, known, BoxKind.BOX, 40, CONFIG, UP, np.random.default_rng(3), doubtful))

    assert draws([]) > 40
    assert draws([left.box]) < draws([]) - 10
    assert draws([half]) == draws([]), "a proposal of the known object itself has no effect"
