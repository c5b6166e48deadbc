"""The points in the frustum of a 2D box."""

from __future__ import annotations

import numpy as np
import pytest
from geometry_strategies import cameras
from hypothesis import given, settings

from annotator.geometry.projection import in_frustum, unproject_depth
from annotator.types import Box2D, Camera


@settings(deadline=None, max_examples=60)
@given(cameras())
def test_the_frustum_of_a_box_contains_exactly_the_pixels_inside(camera: Camera) -> None:
    depth = np.random.default_rng(0).uniform(0.5, 5.0, (camera.height_px, camera.width_px)).astype(np.float32)
    xyz, pixel = unproject_depth(camera, depth)
    inside = in_frustum(camera, xyz, Box2D("x", 9.5, 4.5, 30.5, 20.5))
    v, u = np.divmod(pixel, camera.width_px)
    np.testing.assert_array_equal(inside, (u >= 10) & (u <= 30) & (v >= 5) & (v <= 20))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_points_on_the_edge_are_inside_and_points_behind_the_camera_outside(dtype: type) -> None:
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    cases = {
        (0.0, 0.0, 1.0): True,
        (0.0, 0.0, 50.0): True,
        (0.1, 0.0, 1.0): True,  # on the right edge, which is part of the box
        (0.11, 0.0, 1.0): False,
        (0.0, 0.0, -1.0): False,  # mirrored through the camera
        (0.0, 0.0, 0.0): False,
        (np.nan, 0.0, 1.0): False,
    }
    box = Box2D("x", 300.0, 200.0, 370.0 + 1e-3, 280.0)
    inside = in_frustum(camera, np.array(list(cases), dtype), box)
    assert inside.tolist() == list(cases.values())


def test_points_folded_back_by_the_lens_model_are_outside_the_frustum() -> None:
    camera = Camera(640, 480, 400.0, 400.0, 320.0, 240.0, (-0.3, 0.0, 0.0, 0.0))
    everywhere = Box2D("x", -1e4, -1e4, 1e4, 1e4)
    assert in_frustum(camera, np.array([[0.5, 0.0, 1.0], [3.0, 0.0, 1.0]]), everywhere).tolist() == [True, False]
