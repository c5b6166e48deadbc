"""The nearest upright box, compared with a search over all yaws, and for boxes that are already upright."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import nearest_upright
from annotator.types import OrientedBox

UP = np.array([0.0, -1.0, 0.0])
SIZE = np.array([4.0, 1.8, 1.5])
CENTER = np.array([1.0, 2.0, 15.0])


def upright(yaw: float) -> np.ndarray:
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, sin, 0.0], [0.0, 0.0, -1.0], [-sin, cos, 0.0]])


def angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(Rotation.from_matrix(a.T @ b).magnitude())


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.7))
@settings(max_examples=40)
def test_no_other_upright_rotation_is_nearer(seed: int, lean: float) -> None:
    rng = np.random.default_rng(seed)
    about = rng.normal(size=3)
    about /= np.linalg.norm(about)
    R = Rotation.from_rotvec(about * lean).as_matrix() @ upright(rng.uniform(-np.pi, np.pi))
    found, tilt = nearest_upright(OrientedBox.from_parts(CENTER, R, SIZE), UP)
    np.testing.assert_allclose(found.rotation[:, 2], UP, atol=1e-9)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    assert angle(R, found.rotation) == pytest.approx(tilt, abs=1e-6)
    every = min(angle(R, upright(yaw)) for yaw in np.linspace(-np.pi, np.pi, 361))
    assert tilt <= every + 1e-6
    assert every <= tilt + np.deg2rad(1.0)
    np.testing.assert_array_equal(found.size_m, SIZE)


def test_a_box_upside_down_keeps_its_heading() -> None:
    R = upright(0.4) @ np.diag([1.0, -1.0, -1.0])
    box = OrientedBox.from_parts(CENTER, R, SIZE)
    found, tilt = nearest_upright(box, UP)
    assert tilt < 1e-7 and iou_3d(found, box) == pytest.approx(1.0)
    np.testing.assert_allclose(found.rotation, upright(0.4), atol=1e-7)


@pytest.mark.parametrize("roll", [np.pi / 2, -np.pi / 2])
def test_a_box_that_lies_on_its_side_keeps_its_length(roll: float) -> None:
    """Rotated about its length: height and width are swapped."""
    R = upright(0.4) @ Rotation.from_rotvec([roll, 0.0, 0.0]).as_matrix()
    box = OrientedBox.from_parts(CENTER, R, SIZE)
    found, tilt = nearest_upright(box, UP)
    assert tilt < 1e-7 and iou_3d(found, box) == pytest.approx(1.0)
    np.testing.assert_allclose(found.size_m, [4.0, 1.5, 1.8])
    np.testing.assert_allclose(np.abs(found.rotation[:, 0] @ R[:, 0]), 1.0)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2, 1.4])
def test_a_box_that_stands_on_end_has_its_length_as_height(pitch: float) -> None:
    R = upright(0.4) @ Rotation.from_rotvec([0.0, pitch, 0.0]).as_matrix()
    found, tilt = nearest_upright(OrientedBox.from_parts(CENTER, R, SIZE), UP)
    assert tilt == pytest.approx(abs(abs(pitch) - np.pi / 2), abs=1e-6)
    assert found.size_m[2] == 4.0
    np.testing.assert_allclose(found.rotation[:, 2], UP, atol=1e-9)
