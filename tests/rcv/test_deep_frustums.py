"""The first step's pictures of frustums that are much deeper than wide."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.rcv.config import RcvConfig, ViewConfig
from annotator.rcv.pseudo_view import is_deep
from annotator.rcv.recursion import plan_step, start
from annotator.types import Box2D, PointCloud

CONFIG = RcvConfig(view=ViewConfig(size_px=96, deep_size_px=224, deep=2.0))


def frustum(depth_m: float) -> PointCloud:
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-1, 1) for z in (5.0, 5.0 + depth_m)])
    return PointCloud(corners.astype(np.float32))


@pytest.mark.parametrize(("depth_m", "size_px", "look_px"), [(3.9, 96, 0), (4.1, 224, 224), (60.0, 224, 224)])
def test_a_deep_frustum_is_drawn_and_detected_at_a_larger_size(depth_m: float, size_px: int, look_px: int) -> None:
    cloud = frustum(depth_m)
    assert is_deep(cloud, CONFIG) == (size_px == 224)
    views = plan_step(start(0, Box2D("a", 0.0, 0.0, 9.0, 9.0), cloud, None, CONFIG), CONFIG).views
    assert {(max(view.rgb.shape), view.look_px) for view in views} == {(size_px, look_px)}


@pytest.mark.parametrize("degrees", [-60, -35, 0, 35, 60])
@pytest.mark.parametrize("axis", [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.6, 0.8, 0.0]])
def test_depth_is_measured_along_the_frustum(degrees: float, axis: list[float]) -> None:
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array(axis)).as_matrix().astype(np.float32)
    for depth_m, deep in ((3.0, False), (6.0, True), (60.0, True)):
        assert is_deep(PointCloud(frustum(depth_m).xyz_m @ turn.T), CONFIG) == deep


def test_all_points_of_a_frustum_are_drawn() -> None:
    """Thinning must not remove any pixel of a far object of few points behind many near points."""
    near = np.random.default_rng(0).uniform([-0.5, -1, 5], [-0.1, 1, 5.1], (100_000, 3))
    row, column = np.meshgrid(np.linspace(-1, 1, 40), np.linspace(0.1, 0.5, 10))
    far = np.stack([column, row, np.full_like(row, 6.0)], axis=-1).reshape(-1, 3)
    blue, red = np.full((len(near), 3), [0, 0, 255], np.uint8), np.full((len(far), 3), [255, 0, 0], np.uint8)
    cloud = PointCloud(np.concatenate([near, far]).astype(np.float32), np.concatenate([blue, red]))
    sparse = CONFIG.model_copy(update={"view": ViewConfig(size_px=96, points_per_px=1.0)})
    front, _ = plan_step(start(0, Box2D("a", 0.0, 0.0, 9.0, 9.0), cloud, None, sparse), sparse).views
    shown = {tuple(np.rint((front.axes[:2] @ p - front.origin_m) / front.metres_per_px).astype(int)) for p in far}
    assert len(shown) > 300
    assert all((front.rgb[y, x] == red[0]).all() for x, y in shown)
