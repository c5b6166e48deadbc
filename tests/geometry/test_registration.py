"""Registration of an object's points with a cloud."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from annotator.geometry.normals import normals_knn
from annotator.geometry.registration import register, register_surface, share_found

UP = np.array([0.0, 0.0, 1.0])


def corner(rng: np.random.Generator, points: int = 400) -> np.ndarray:
    """Points on three faces of a box without symmetries, as a sensor sees them."""
    xyz = rng.uniform(-0.5, 0.5, (points, 3))
    face = rng.integers(0, 3, points)
    xyz[np.arange(points), face] = 0.5
    return np.asarray(xyz * [1.0, 0.6, 1.6])


def pose_error(pose: tuple[np.ndarray, np.ndarray], turn: np.ndarray, shift: np.ndarray) -> tuple[float, float]:
    return float(Rotation.from_matrix(pose[0].T @ turn).magnitude()), float(np.linalg.norm(pose[1] - shift))


@given(
    st.integers(0, 20),
    st.floats(-0.15, 0.15),
    st.tuples(*[st.floats(-0.08, 0.08)] * 3),
    st.sampled_from([None, UP]),
)
def test_a_small_motion_is_found(
    seed: int, angle: float, shift: tuple[float, float, float], up: np.ndarray | None
) -> None:
    points = corner(np.random.default_rng(seed))
    turn, moved = Rotation.from_rotvec(angle * UP).as_matrix(), np.array(shift)
    pose = register(points, KDTree(points @ turn.T + moved), (np.eye(3), np.zeros(3)), 0.35, up)
    assert pose is not None
    turned_by, moved_by = pose_error(pose, turn, moved)
    assert turned_by < 0.03
    assert moved_by < 0.03


def test_other_objects_and_hidden_parts_do_no_harm() -> None:
    rng = np.random.default_rng(3)
    points = corner(rng)
    turn, shift = Rotation.from_rotvec(0.1 * UP).as_matrix(), np.array([0.08, -0.05, 0.02])
    visible = (points @ turn.T + shift)[points[:, 0] > -0.25]
    others = rng.uniform([0.9, -1.0, -1.0], [1.4, 1.0, 1.0], (500, 3))
    cloud = KDTree(np.concatenate([visible, others]))
    pose = register(points, cloud, (np.eye(3), np.zeros(3)), 0.35)
    assert pose is not None
    turned_by, moved_by = pose_error(pose, turn, shift)
    assert turned_by < 0.05
    assert moved_by < 0.05
    assert share_found(points, cloud, pose, 0.05) == pytest.approx(len(visible) / len(points), abs=0.1)


def test_with_a_vertical_the_rotation_stays_about_it() -> None:
    points = corner(np.random.default_rng(4))
    turn = Rotation.from_rotvec([0.1, 0.0, 0.1]).as_matrix()
    pose = register(points, KDTree(points @ turn.T), (np.eye(3), np.zeros(3)), 0.35, UP)
    assert pose is not None
    np.testing.assert_allclose(pose[0] @ UP, UP, atol=1e-12)


def test_points_without_a_cloud_nearby_have_no_pose() -> None:
    points = corner(np.random.default_rng(6))
    assert register(points, KDTree(points + 5.0), (np.eye(3), np.zeros(3)), 0.35) is None
    assert share_found(points, KDTree(points + 5.0), (np.eye(3), np.zeros(3)), 0.05) == 0.0


def test_a_surface_that_turns_is_turned_all_the_way_by_planes() -> None:
    """Points that come into view pull the nearest points back; planes let the surface slide along itself."""
    rng = np.random.default_rng(0)
    angles, heights = rng.uniform(-np.pi, np.pi, 6000), rng.uniform(-0.5, 0.5, 6000)
    xyz = np.stack([0.3 * np.cos(angles), 0.2 * np.sin(angles), heights], axis=1)
    normals = np.stack([np.cos(angles) / 0.3, np.sin(angles) / 0.2, np.zeros(6000)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    turn = Rotation.from_rotvec(0.2 * UP).as_matrix()
    before, after = normals[:, 1] < 0, (normals @ turn.T)[:, 1] < 0
    cloud, around = xyz[after] @ turn.T, normals[after] @ turn.T
    start = (np.eye(3), cloud.mean(axis=0) - xyz[before].mean(axis=0))
    by_points = register(xyz[before], KDTree(cloud), start, 0.1, UP)
    by_planes = register_surface(xyz[before], KDTree(cloud), around, start, 0.1, UP)
    assert by_points is not None and by_planes is not None
    error = pose_error(by_planes, turn, np.zeros(3))
    assert error[0] < 0.02 and error[1] < 0.01
    assert error[0] < 0.2 * pose_error(by_points, turn, np.zeros(3))[0]


@pytest.mark.parametrize("up", [None, UP])
def test_points_on_a_line_have_no_planes_to_register_with(up: np.ndarray | None) -> None:
    line = np.linspace(0, 1, 200)[:, None] * [0.3, 0.2, 1.0] + [0.0, 0.0, 2.0]
    normals = normals_knn(line).astype(np.float64)
    assert not normals.any()
    assert register_surface(line + 0.01, KDTree(line), normals, (np.eye(3), np.zeros(3)), 0.1, up) is None
