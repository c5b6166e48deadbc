"""Rotations, frames and the paper's corner form."""

from __future__ import annotations

import numpy as np
import pytest
from geometry_strategies import boxes, rigid_transforms, rotations, vectors
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.geometry.oriented_box import box_corners
from annotator.geometry.transforms import (
    corners_4x8,
    nearest_rotation,
    right_handed_frame,
    rotation_angle_rad,
    rotation_between_axes,
    unit,
)
from annotator.types import OrientedBox
from annotator.types.errors import GeometryError

NOTHING = np.zeros(3)


def is_rotation(matrix: np.ndarray) -> bool:
    return np.allclose(matrix.T @ matrix, np.eye(3), atol=1e-12) and np.linalg.det(matrix) > 0


@settings(deadline=None)
@given(vectors(), vectors())
def test_frame_is_right_handed_and_keeps_its_major_axis(major: np.ndarray, hint: np.ndarray) -> None:
    assume(np.linalg.norm(major) > 1e-6)
    frame = right_handed_frame(major, hint)
    assert is_rotation(frame)
    np.testing.assert_allclose(frame[:, 0], unit(major), atol=1e-12)
    if np.linalg.norm(np.cross(unit(major), hint)) > 1e-6:
        assert frame[:, 1] @ hint > 0
        assert abs(frame[:, 2] @ hint) < 1e-9


@pytest.mark.parametrize("hint", [(0.0, 0.0, 5.0), (0.0, 0.0, -1.0), (0.0, 0.0, 0.0), (1e-13, 0.0, 1.0)])
def test_frame_with_a_hint_along_the_major_axis(hint: tuple[float, float, float]) -> None:
    assert is_rotation(right_handed_frame(np.array([0.0, 0.0, 2.0]), np.array(hint)))


def test_frame_of_y_and_z_starts_at_y() -> None:
    frame = right_handed_frame(np.array([0.0, 3.0, 0.0]), np.array([0.0, 1.0, 1.0]))
    np.testing.assert_allclose(frame, [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-15)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: unit(NOTHING), "no direction"),
        (lambda: unit(np.array([np.nan, 0.0, 1.0])), "no direction"),
        (lambda: right_handed_frame(NOTHING, np.ones(3)), "no direction"),
        (lambda: right_handed_frame(np.ones(3), np.array([np.inf, 0.0, 0.0])), "finite"),
        (lambda: rotation_between_axes(np.ones(3), NOTHING), "no direction"),
        (lambda: nearest_rotation(np.full((3, 3), np.nan)), "finite"),
    ],
)
def test_what_has_no_direction_is_refused(call, message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        call()


@settings(deadline=None)
@given(vectors(), vectors())
def test_rotation_between_axes_is_the_smallest_that_maps_one_onto_the_other(a: np.ndarray, b: np.ndarray) -> None:
    assume(np.linalg.norm(a) > 1e-3 and np.linalg.norm(b) > 1e-3)
    rotation = rotation_between_axes(a, b)
    assert is_rotation(rotation)
    np.testing.assert_allclose(rotation @ unit(a), unit(b), atol=1e-12)
    between = np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)
    assert rotation_angle_rad(np.eye(3), rotation) == pytest.approx(between, abs=1e-7)


@pytest.mark.parametrize("off", [0.0, 1e-16, 1e-12, 1e-8, 1e-4])
def test_rotation_between_opposite_axes(off: float) -> None:
    a = np.array([0.6, 0.8, 0.0])
    b = unit(-a + off * np.array([0.0, 0.0, 1.0]))
    rotation = rotation_between_axes(a, b)
    assert is_rotation(rotation)
    np.testing.assert_allclose(rotation @ a, b, atol=1e-14)


@settings(deadline=None)
@given(rotations(), st.floats(1e-12, np.pi), vectors())
def test_rotation_angle_is_that_of_the_relative_rotation(first: Rotation, angle: float, axis: np.ndarray) -> None:
    assume(np.linalg.norm(axis) > 1e-3)
    second = first * Rotation.from_rotvec(angle * unit(axis))
    measured = rotation_angle_rad(first.as_matrix(), second.as_matrix())
    assert measured == pytest.approx(angle, abs=1e-14, rel=1e-7)


@settings(deadline=None)
@given(rotations(), st.tuples(vectors(0.05), vectors(0.05), vectors(0.05)))
def test_nearest_rotation_is_nearer_than_the_one_it_was_disturbed_from(
    rotation: Rotation, noise: tuple[np.ndarray, ...]
) -> None:
    disturbed = rotation.as_matrix() + np.array(noise)
    nearest = nearest_rotation(disturbed)
    assert is_rotation(nearest)
    assert np.linalg.norm(nearest - disturbed) <= np.linalg.norm(rotation.as_matrix() - disturbed) + 1e-12


def test_nearest_rotation_of_a_mirror_is_proper() -> None:
    assert is_rotation(nearest_rotation(np.diag([1.0, 1.0, -1.0])))


@settings(deadline=None)
@given(boxes(), rigid_transforms())
def test_a_4x4_matrix_maps_the_corners_of_equation_1(box: OrientedBox, T_dst_camera: RigidTransform) -> None:
    mapped = T_dst_camera.as_matrix() @ corners_4x8(box)
    np.testing.assert_allclose(mapped[:3].T, box_corners(box.transformed(T_dst_camera)), atol=1e-9)
    np.testing.assert_array_equal(mapped[3], 1.0)
