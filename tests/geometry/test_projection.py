"""Pixels, rays and depth images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from geometry_strategies import cameras
from hypothesis import given, settings
from hypothesis import strategies as st

from annotator.geometry.outline import Sight
from annotator.geometry.projection import (
    distort,
    in_frustum,
    in_metres,
    pixel_rays,
    project,
    radius_limit_squared,
    straightened,
    undistort,
    unproject_depth,
)
from annotator.types import Box2D, Camera, OrientedBox

PINHOLE = Camera(640, 480, 500.0, 510.0, 319.5, 239.5)


def depth_image(camera: Camera, seed: int, holes: bool = True) -> np.ndarray:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.3, 8.0, (camera.height_px, camera.width_px)).astype(np.float32)
    if holes:
        depth[rng.random(depth.shape) < 0.2] = 0.0
        depth[rng.random(depth.shape) < 0.1] = np.nan
    return depth


@settings(deadline=None)
@given(cameras(), st.integers(0, 1000))
def test_project_of_unproject_is_the_pixel(camera: Camera, seed: int) -> None:
    depth = depth_image(camera, seed)
    xyz, pixel = unproject_depth(camera, depth)
    assert xyz.dtype == np.float32
    np.testing.assert_array_equal(pixel, np.flatnonzero(depth > 0))
    np.testing.assert_array_equal(xyz[:, 2], depth.reshape(-1)[pixel])
    v, u = np.divmod(pixel, camera.width_px)
    np.testing.assert_allclose(project(camera, xyz), np.stack([u, v], axis=1), atol=1e-3)


@settings(deadline=None)
@given(cameras())
def test_project_agrees_with_opencv(camera: Camera) -> None:
    xyz = np.random.default_rng(0).uniform(-1, 1, (50, 3)) * [1.0, 0.8, 0.5] + [0.0, 0.0, 2.5]
    coefficients = np.array(camera.distortion) if camera.distortion else None
    want = cv2.projectPoints(xyz, np.zeros(3), np.zeros(3), camera.matrix, coefficients)[0][:, 0]
    np.testing.assert_allclose(project(camera, xyz), want, atol=1e-9)


def test_the_centre_of_the_first_pixel_is_0_0() -> None:
    """The pixel convention: the ray K^-1 (0, 0, 1) projects to (0, 0), and the image's corner is at -0.5."""
    ray = np.linalg.inv(PINHOLE.matrix) @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(project(PINHOLE, 3.0 * ray[None]), [[0.0, 0.0]], atol=1e-12)
    depth = np.zeros((480, 640), np.float32)
    depth[0, 0] = 2.0
    xyz, pixel = unproject_depth(PINHOLE, depth)
    np.testing.assert_allclose(xyz, 2.0 * ray[None], rtol=1e-6)
    assert pixel.tolist() == [0]


@pytest.mark.parametrize("point", [(0.0, 0.0, 0.0), (1.0, 0.0, -2.0), (0.0, 0.0, np.nan), (np.nan, 0.0, 1.0)])
@pytest.mark.parametrize("distortion", [(), (0.1, 0.0, 0.0, 0.0)])
def test_points_behind_the_camera_have_no_pixel(point: tuple[float, ...], distortion: tuple[float, ...]) -> None:
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0, distortion)
    both = project(camera, np.array([point, (0.0, 0.0, 1.0)]))
    assert np.isnan(both[0]).any()
    np.testing.assert_allclose(both[1], [320.0, 240.0])


def test_a_point_beyond_the_lens_models_range_is_not_folded_back_into_the_image() -> None:
    camera = Camera(640, 480, 400.0, 400.0, 320.0, 240.0, (-0.3, 0.0, 0.0, 0.0))
    far_aside = np.array([[1.8, 0.0, 1.0]])
    folded = cv2.projectPoints(far_aside, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion))[0]
    assert 0 < folded[0, 0, 0] < 640
    assert np.isnan(project(camera, far_aside)).all()


def test_strong_barrel_distortion_is_inverted_up_to_its_turning_point() -> None:
    barrel = (-0.3, 0.0, 0.0, 0.0)
    # r - 0.3 r^3 grows up to r^2 = 1 / 0.9
    assert radius_limit_squared(barrel) == pytest.approx(1 / 0.9)
    assert np.isfinite(distort(barrel, np.array([[1.0, 0.0]]))).all()
    assert np.isnan(distort(barrel, np.array([[3.0, 0.0]]))).all()
    near_limit = np.array([[1.04, 0.0], [0.0, -1.05]])
    np.testing.assert_allclose(undistort(barrel, distort(barrel, near_limit)), near_limit, atol=1e-6)
    assert np.isnan(undistort(barrel, np.array([[1.5, 0.0]]))).all()
    # pixels beyond have no point
    camera = Camera(64, 48, 25.0, 25.0, 31.5, 23.5, barrel)
    xyz, pixel = unproject_depth(camera, np.ones((48, 64), np.float32))
    assert 0 < len(xyz) < 64 * 48 and np.isfinite(xyz).all() and 0 not in pixel


INF, NAN = float("inf"), float("nan")
TABLE = [
    ("u2", [0, 1, 2000, 65503, 65504, 65535], [0, 1, 2000, 65503, 0, 0]),
    ("i2", [-1, 0, 2000, 32767, -32768], [0, 0, 2000, 0, 0]),
    ("i4", [-5, 2000, 65535, 70000, 2**31 - 1], [0, 2000, 0, 70000, 0]),
    ("f2", [-1, NAN, INF, 65504, 2000], [0, 0, 0, 0, 2000]),
    ("f4", [-INF, NAN, INF, -2, 65504, 65535, 2000.5], [0, 0, 0, 0, 0, 0, 2000.5]),
    ("f8", [NAN, 65535, 3], [0, 0, 3]),
]


@pytest.mark.parametrize("units_per_m", [1.0, 1000.0, 5000.0])
@pytest.mark.parametrize(("kind", "raw", "units"), TABLE)
def test_depths_in_metres(kind: str, raw: list[float], units: list[float], units_per_m: float):
    for order in "<>":
        depth_m = in_metres(np.array([raw], order + kind), units_per_m)
        np.testing.assert_array_equal(depth_m, np.array([units], np.float32) / np.float32(units_per_m))
        assert depth_m.dtype == np.float32


@settings(deadline=None)
@given(cameras())
def test_the_frustum_of_a_box_contains_exactly_the_pixels_inside(camera: Camera) -> None:
    depth = np.random.default_rng(0).uniform(0.5, 5.0, (camera.height_px, camera.width_px)).astype(np.float32)
    xyz, pixel = unproject_depth(camera, depth)
    inside = in_frustum(camera, xyz, Box2D("x", 9.5, 4.5, 30.5, 20.5))
    v, u = np.divmod(pixel, camera.width_px)
    np.testing.assert_array_equal(inside, (u >= 10) & (u <= 30) & (v >= 5) & (v <= 20))


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
