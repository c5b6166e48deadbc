"""Pixels, rays and depth images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from geometry_strategies import cameras
from hypothesis import given, settings
from hypothesis import strategies as st

from annotator.geometry.projection import pixel_colors, project, unproject_depth
from annotator.types import Camera
from annotator.types.errors import GeometryError

PINHOLE = Camera(640, 480, 500.0, 510.0, 319.5, 239.5)


def depth_image(camera: Camera, seed: int, holes: bool = True) -> np.ndarray:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.3, 8.0, (camera.height_px, camera.width_px)).astype(np.float32)
    if holes:
        depth[rng.random(depth.shape) < 0.2] = 0.0
        depth[rng.random(depth.shape) < 0.1] = np.nan
    return depth


@settings(deadline=None, max_examples=60)
@given(cameras(), st.integers(0, 1000))
def test_project_of_unproject_is_the_pixel(camera: Camera, seed: int) -> None:
    depth = depth_image(camera, seed)
    xyz, pixel = unproject_depth(camera, depth)
    assert xyz.dtype == np.float32
    np.testing.assert_array_equal(pixel, np.flatnonzero(depth > 0))
    np.testing.assert_array_equal(xyz[:, 2], depth.reshape(-1)[pixel])
    v, u = np.divmod(pixel, camera.width_px)
    np.testing.assert_allclose(project(camera, xyz), np.stack([u, v], axis=1), atol=1e-3)


@settings(deadline=None, max_examples=60)
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


def test_pixels_beyond_the_lens_models_range_have_no_point() -> None:
    camera = Camera(64, 48, 25.0, 25.0, 31.5, 23.5, (-0.3, 0.0, 0.0, 0.0))
    xyz, pixel = unproject_depth(camera, np.ones((48, 64), np.float32))
    assert 0 < len(xyz) < 64 * 48
    assert np.isfinite(xyz).all()
    assert 0 not in pixel


def test_negative_and_infinite_depth_values_are_ignored() -> None:
    depth = np.array([[1.0, -1.0], [np.inf, 2.0]], np.float32)
    xyz, pixel = unproject_depth(Camera(2, 2, 1.0, 1.0, 0.0, 0.0), depth)
    assert pixel.tolist() == [0, 3]
    np.testing.assert_allclose(xyz, [[0, 0, 1], [2, 2, 2]])


def test_depth_of_another_size_is_refused() -> None:
    with pytest.raises(GeometryError, match="320 x 240 px, the camera 640 x 480"):
        unproject_depth(PINHOLE, np.ones((240, 320), np.float32))


def test_colours_are_those_of_the_points_pixels() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    _, pixel = unproject_depth(PINHOLE, depth_image(PINHOLE, 1))
    np.testing.assert_array_equal(pixel_colors(rgb, pixel), rgb.reshape(-1, 3)[pixel])
    np.testing.assert_array_equal(pixel_colors(rgb[:, ::-1], pixel), rgb[:, ::-1].reshape(-1, 3)[pixel])
    assert pixel_colors(rgb, pixel[:0]).shape == (0, 3)
    for wrong in (-1, 480 * 640):
        with pytest.raises(IndexError, match="not all in an image of 307200 pixels"):
            pixel_colors(rgb, np.array([0, wrong], np.int32))
