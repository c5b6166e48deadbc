"""The box of least volume around points."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import box_corners, contains, tightest_box
from annotator.rcv.rotations import free_grid, yaw_grid
from annotator.types import OrientedBox

UP = np.array([0.0, -1.0, 0.0])


@pytest.mark.parametrize("seed", range(3))
def test_a_free_box_is_found_from_its_corners(seed: int) -> None:
    rotation = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    box = OrientedBox.from_parts(np.array([0.1, 0.2, 2.0]), rotation, np.array([0.3, 0.5, 1.1]))
    found = tightest_box(box_corners(box), free_grid())
    assert iou_3d(found, box) > 0.98
    assert contains(found, box_corners(box), 1e-6).all()


def test_an_upright_box_turns_about_the_vertical_only() -> None:
    points = (
        np.random.default_rng(0).normal(0, (0.1, 0.4, 0.2), (500, 3)) @ Rotation.from_rotvec([0, 0.7, 0.3]).as_matrix()
    )
    found = tightest_box(points, yaw_grid(UP), UP)
    assert np.abs(found.rotation.T @ UP).max() == pytest.approx(1.0)
    assert contains(found, points, 1e-6).all()


def test_points_in_a_plane_have_a_flat_box() -> None:
    points = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 2.0, 1.0], [0.0, 2.0, 1.0]])
    assert contains(tightest_box(points, yaw_grid(UP), UP), points, 1e-6).all()
