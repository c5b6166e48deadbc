"""Projection axes: each strategy on clouds with known axes, and the fallbacks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import box_surface, some_box
from scipy.spatial.transform import Rotation

from annotator.geometry.normals import normals_knn
from annotator.rcv.axes import (
    BOX_SYMMETRIES,
    axes_angle_rad,
    find_axes,
    match_axes,
    upright_axes,
)
from annotator.rcv.config import Orientation, RcvConfig, Strategy
from annotator.types import PointCloud

FREE, UPRIGHT = RcvConfig(orientation=Orientation.FREE), RcvConfig(orientation=Orientation.UPRIGHT)
UP = np.array([0.0, -1.0, 0.0])


def random_axes(seed: int) -> np.ndarray:
    return Rotation.random(rng=np.random.default_rng(seed)).as_matrix().T


@given(st.integers(0, 1000), st.integers(0, 1000), st.integers(0, 23))
def test_relabelled_axes_have_an_angle_of_0(seed: int, other: int, symmetry: int) -> None:
    axes, reference = random_axes(seed), random_axes(other)
    relabelled = BOX_SYMMETRIES[symmetry] @ axes
    assert axes_angle_rad(relabelled, axes) == pytest.approx(0, abs=1e-6)
    matched = match_axes(relabelled, reference)
    np.testing.assert_allclose(matched, match_axes(axes, reference), atol=1e-12)
    assert np.linalg.det(matched) == pytest.approx(1)


@given(st.integers(0, 1000))
def test_upright_axes_are_level_right_handed_and_point_forward(seed: int) -> None:
    rng = np.random.default_rng(seed)
    forward, up = rng.normal(size=3), rng.normal(size=3)
    up /= np.linalg.norm(up)
    axes = upright_axes(forward, up)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(axes) == pytest.approx(1)
    np.testing.assert_allclose(axes[1], -up, atol=1e-9)
    assert axes[2] @ forward >= 0


def test_eigenvectors_of_a_long_box_are_its_axes() -> None:
    box = some_box([0, 0, 3], [0.3, 0.5, -0.2], [1.0, 0.5, 0.2])
    cloud = PointCloud(box_surface(box, 3000, np.random.default_rng(0)).astype(np.float32))
    found = find_axes(cloud, Strategy.EIGENVECTORS, np.eye(3), None, FREE)
    assert found.strategy is Strategy.EIGENVECTORS
    assert axes_angle_rad(found.axes, box.rotation.T) < 0.05


@pytest.mark.parametrize("yaw", [0.0, 0.4, 1.1, -0.9])
def test_normals_give_the_axes_of_a_cube_and_eigenvectors_do_not(yaw: float) -> None:
    box = some_box([0, 0, 3], [0.2, yaw, 0.1], [0.5, 0.5, 0.5])
    xyz = box_surface(box, 3000, np.random.default_rng(0)).astype(np.float32)
    cloud = PointCloud(xyz, normals=normals_knn(xyz))
    found = find_axes(cloud, Strategy.NORMALS, np.eye(3), None, FREE)
    assert found.strategy is Strategy.NORMALS and found.fallback == ()
    assert axes_angle_rad(found.axes, box.rotation.T) < 0.08
    assert find_axes(cloud, Strategy.EIGENVECTORS, np.eye(3), None, FREE).strategy is Strategy.CAMERA
