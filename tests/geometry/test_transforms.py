"""Directions, axes, level poses and homogeneous corners."""

from __future__ import annotations

import numpy as np
import pytest
from geometry_strategies import boxes, rigid_transforms, vectors
from hypothesis import assume, given, settings
from scipy.spatial.transform import RigidTransform

from annotator.geometry.oriented_box import box_corners
from annotator.geometry.transforms import (
    corners_4x8,
    right_handed_axes,
    unit,
)
from annotator.types import OrientedBox
from annotator.types.errors import GeometryError

ZERO = np.zeros(3)


def is_rotation(matrix: np.ndarray) -> bool:
    return np.allclose(matrix.T @ matrix, np.eye(3), atol=1e-12) and np.linalg.det(matrix) > 0


@settings(deadline=None)
@given(vectors(), vectors())
def test_axes_are_right_handed_and_keep_the_major_axis(major: np.ndarray, hint: np.ndarray) -> None:
    assume(np.linalg.norm(major) > 1e-6)
    frame = right_handed_axes(major, hint)
    assert is_rotation(frame)
    np.testing.assert_allclose(frame[:, 0], unit(major), atol=1e-12)
    if np.linalg.norm(np.cross(unit(major), hint)) > 1e-6:
        assert frame[:, 1] @ hint > 0
        assert abs(frame[:, 2] @ hint) < 1e-9


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: unit(ZERO), "no direction"),
        (lambda: unit(np.array([np.nan, 0.0, 1.0])), "no direction"),
        (lambda: right_handed_axes(ZERO, np.ones(3)), "no direction"),
        (lambda: right_handed_axes(np.ones(3), np.array([np.inf, 0.0, 0.0])), "finite"),
    ],
)
def test_vectors_without_direction_are_refused(call, message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        call()


@settings(deadline=None)
@given(boxes(), rigid_transforms())
def test_a_4x4_matrix_maps_homogeneous_corners_as_in_equation_1(box: OrientedBox, T_dst_camera: RigidTransform) -> None:
    mapped = T_dst_camera.as_matrix() @ corners_4x8(box)
    np.testing.assert_allclose(mapped[:3].T, box_corners(box.transformed(T_dst_camera)), atol=1e-9)
    np.testing.assert_array_equal(mapped[3], 1.0)
