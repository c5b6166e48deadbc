"""Projection axes: each strategy on clouds with known axes, and the fallbacks."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import box_surface, some_box

from annotator.geometry.normals import normals_knn
from annotator.rcv.axes import axes_angle_rad, find_axes
from annotator.rcv.config import Orientation, RcvConfig, Strategy
from annotator.types import PointCloud

FREE, UPRIGHT = RcvConfig(orientation=Orientation.FREE), RcvConfig(orientation=Orientation.UPRIGHT)


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
