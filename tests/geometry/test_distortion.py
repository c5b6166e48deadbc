"""The lens model against OpenCV's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from geometry_strategies import cameras
from hypothesis import given, settings

from annotator.geometry.distortion import distort, radius_limit_squared, undistort
from annotator.types import Camera


def grid(reach: float) -> np.ndarray:
    steps = np.linspace(-reach, reach, 21)
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)


@settings(deadline=None)
@given(cameras())
def test_distort_agrees_with_opencv(camera: Camera) -> None:
    xy = grid(0.6)
    points = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    coefficients = np.array(camera.distortion) if camera.distortion else None
    want = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), coefficients)[0][:, 0]
    np.testing.assert_allclose(distort(camera.distortion, xy), want, atol=1e-12)


@settings(deadline=None)
@given(cameras())
def test_undistort_inverts_distort(camera: Camera) -> None:
    xy = grid(0.6)
    np.testing.assert_allclose(undistort(camera.distortion, distort(camera.distortion, xy)), xy, atol=1e-8)


def test_strong_barrel_distortion_is_inverted_up_to_its_turning_point() -> None:
    barrel = (-0.3, 0.0, 0.0, 0.0)
    # r - 0.3 r^3 grows up to r^2 = 1 / 0.9
    assert radius_limit_squared(barrel) == pytest.approx(1 / 0.9)
    assert np.isfinite(distort(barrel, np.array([[1.0, 0.0]]))).all()
    assert np.isnan(distort(barrel, np.array([[3.0, 0.0]]))).all()
    near_limit = np.array([[1.04, 0.0], [0.0, -1.05]])
    np.testing.assert_allclose(undistort(barrel, distort(barrel, near_limit)), near_limit, atol=1e-6)
    assert np.isnan(undistort(barrel, np.array([[1.5, 0.0]]))).all()
