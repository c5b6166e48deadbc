"""The ground below a cloud."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.geometry.ground import find_ground, ground_axes

UP = np.array([0.0, -1.0, 0.0])


def street(slope: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A road 1.7 m below the camera that climbs ahead, with a car 4 m long, a wall, and echoes from below; the height
    of each point above the road.
    """
    road = np.column_stack([rng.uniform(-20, 20, 20_000), np.zeros(20_000), rng.uniform(0, 60, 20_000)])
    car = rng.uniform([2, 0.2, 10], [4, 1.5, 14], (2000, 3))
    wall = np.column_stack([np.full(3000, -15.0), rng.uniform(0, 6, 3000), rng.uniform(5, 50, 3000)])
    echoes = np.column_stack([rng.uniform(-20, 20, 12), np.full(12, -2.5), rng.uniform(0, 60, 12)])
    x, above, ahead = np.concatenate([road, car, wall, echoes]).T
    return np.column_stack([x, 1.7 - above - slope * ahead, ahead]), above


@pytest.mark.parametrize("slope", [0.0, 0.08, -0.05])
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.3, 0.1, -0.2)])
def test_a_road_is_ground_also_where_it_climbs_and_what_stands_on_it_is_not(slope: float, turn: tuple) -> None:
    points, above = street(slope, np.random.default_rng(0))
    rotation = Rotation.from_rotvec(turn)
    xyz = rotation.apply(points).astype(np.float32)
    ground = find_ground(xyz, rotation.apply(UP))
    found = ground.above_m(xyz)
    is_road, stands = above == 0, above > 0.6
    assert np.mean(found[is_road] < ground.thickness_m) > 0.95
    assert np.mean(found[stands] > ground.thickness_m) > 0.98
    np.testing.assert_allclose(np.median(found[stands] - above[stands]), 0, atol=0.25)
    assert ground.level_m == pytest.approx(-1.7, abs=0.25)


def test_axes_are_right_handed_also_for_a_camera_that_looks_down() -> None:
    for up in (UP, np.array([0.0, 0.0, -1.0]), np.array([0.6, -0.8, 0.0])):
        axes = ground_axes(up)
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1)
        np.testing.assert_array_equal(axes[2], up)


@pytest.mark.parametrize("n", [0, 1, 3])
def test_a_cloud_of_hardly_any_points_has_a_ground(n: int) -> None:
    xyz = np.tile(np.array([[0.5, 1.0, 2.0]], np.float32), (n, 1))
    ground = find_ground(xyz, UP)
    assert np.isfinite(ground.above_m(xyz)).all()
    assert ground.above_m(np.array([[0, 0, 0]], np.float32)).shape == (1,)
