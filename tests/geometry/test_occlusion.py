"""Occlusion of boxes in scenes with a known result, and undistorted images."""

from __future__ import annotations

import numpy as np
import pytest

from annotator.geometry.occlusion import Hidden, Sight
from annotator.geometry.projection import pixel_rays, project, straightened
from annotator.types import Camera, OrientedBox

PIXELS = pixel_rays(Camera(40, 40, 40.0, 40.0, 19.5, 19.5)).reshape(-1, 2)
BOX = OrientedBox.from_parts(np.array([0.0, 0.0, 5.0]), np.eye(3), np.array([2.0, 2.0, 2.0]))


def points(depth_m: np.ndarray) -> np.ndarray:
    return (np.column_stack([PIXELS, np.ones(len(PIXELS))]) * depth_m[:, None]).astype(np.float32)


@pytest.mark.parametrize(
    ("left_m", "right_m", "margin_m", "share"),
    [
        (4.0, 4.0, 0.0, 0.0),  # the box's own front, up to rounding
        (4.5, 9.0, 0.0, 0.0),  # points inside the box, and a wall seen through it
        (2.0, 9.0, 0.0, 0.5),
        (2.0, 3.9, 0.2, 0.5),
        (2.0, 3.9, 0.05, 1.0),
    ],
)
def test_nearer_points_hide_a_box(left_m: float, right_m: float, margin_m: float, share: float) -> None:
    depth = np.where(PIXELS[:, 0] < 0, left_m, right_m) * 1.000001
    hidden = Sight(points(depth)).hidden(BOX, margin_m)
    assert hidden.rays == 400  # 20 x 20 pixels: the front face is 2 m at 4 m
    assert hidden.share == pytest.approx(share)


def test_the_hidden_share_is_nan_without_points() -> None:
    assert Sight(np.zeros((0, 3), np.float32)).hidden(BOX) == Hidden(0, 0)
    assert np.isnan(Hidden(0, 0).share)
    behind = OrientedBox.from_parts(np.array([0.0, 0.0, -5.0]), np.eye(3), np.ones(3))
    assert Sight(points(np.full(len(PIXELS), 2.0))).hidden(behind).rays == 0


def test_a_box_around_the_camera_is_not_hidden() -> None:
    around = OrientedBox.from_parts(np.zeros(3), np.eye(3), np.full(3, 2.0))
    hidden = Sight(points(np.full(len(PIXELS), 0.5))).hidden(around)
    assert hidden.rays == len(PIXELS)
    assert hidden.share == 0.0


def test_an_undistorted_image_shows_points_where_the_ideal_camera_projects_them() -> None:
    lens = Camera(64, 48, 50.0, 50.0, 31.5, 23.5, (-0.2, 0.05, 0.001, 0.002))
    spot = np.array([[0.3, -0.2, 1.0]])
    u, v = np.rint(project(lens, spot)[0]).astype(int)
    rgb = np.zeros((48, 64, 3), np.uint8)
    rgb[v - 1 : v + 2, u - 1 : u + 2] = (10, 200, 30)
    ideal, straight = straightened(lens, rgb)
    assert ideal.is_ideal
    assert (ideal.fx, ideal.cx, ideal.width_px) == (lens.fx, lens.cx, lens.width_px)
    u, v = np.rint(project(ideal, spot)[0]).astype(int)
    np.testing.assert_array_equal(straight[v, u], (10, 200, 30))
    assert straightened(ideal, straight) == (ideal, straight)
