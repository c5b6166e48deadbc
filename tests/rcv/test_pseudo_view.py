"""Pseudo-views: the pixel of a point, the nearest point of a pixel, and the conversion back to metres."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from annotator.rcv.config import ViewConfig
from annotator.rcv.pseudo_view import BACKGROUND, drawn_points, render_pairs
from annotator.types import Box2D, PointCloud

VIEW = ViewConfig(size_px=100, padding=0.05)


def cloud_of(points: list[list[float]], colors: list[list[int]] | None = None) -> PointCloud:
    rgb = None if colors is None else np.array(colors, np.uint8)
    return PointCloud(np.array(points, np.float32), rgb)


def pixel_of(view, point) -> tuple[int, int]:
    uv = (view.axes[:2] @ np.asarray(point, np.float64) - view.origin_m) / view.metres_per_px
    return int(np.rint(uv[1])), int(np.rint(uv[0]))


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 60))
def test_every_point_is_drawn_at_its_pixel(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    frame = Rotation.random(rng=rng).as_matrix().T
    cloud = PointCloud(rng.normal(size=(count, 3)).astype(np.float32), np.full((count, 3), 7, np.uint8))
    for view in render_pairs(cloud, [frame], VIEW):
        for point in cloud.xyz_m:
            assert tuple(view.rgb[pixel_of(view, point)]) == (7, 7, 7)


@given(st.floats(-0.5, 60), st.floats(-0.5, 60), st.floats(1, 30), st.floats(1, 30))
def test_conversion_to_metres_and_back_keeps_a_box(x: float, y: float, width: float, height: float) -> None:
    front, _ = render_pairs(cloud_of([[0, 0, 1], [1, 2, 2]]), [np.eye(3)], VIEW)
    box = Box2D("a", x, y, x + width, y + height)
    again = front.box_px(front.interval_m(box), "a")
    assert again.xyxy == pytest.approx(box.xyxy, abs=1e-9)


def test_scale_is_uniform_and_the_longer_side_fills_the_picture() -> None:
    front, _ = render_pairs(cloud_of([[0, 0, 1], [4, 1, 1]]), [np.eye(3)], VIEW)
    assert front.rgb.shape[1] == VIEW.size_px
    assert front.rgb.shape[0] == pytest.approx(VIEW.size_px / 4, abs=2)
    np.testing.assert_allclose(front.extent_m[0], 4 * 1.1, rtol=1e-6)


def test_additional_points_lie_within_the_view() -> None:
    corners = np.array([[-3.0, 0, 1], [3, 0, 1]])
    front, _ = render_pairs(cloud_of([[0, 0, 1], [0.1, 0.1, 1]]), [np.eye(3)], VIEW, corners)
    assert front.origin_m[0] < -3 and front.origin_m[0] + front.extent_m[0] > 3


def test_sparse_points_are_drawn_larger_than_dense_ones() -> None:
    rng = np.random.default_rng(0)

    def covered(n: int) -> float:
        cloud = PointCloud(rng.uniform(0, 1, (n, 3)).astype(np.float32), np.zeros((n, 3), np.uint8))
        view = render_pairs(cloud, [np.eye(3)], VIEW)[0]
        return float((view.rgb[..., 0] == 0).sum()) / n

    assert covered(50) > 20
    assert covered(20_000) < 1.5


def test_a_dense_cloud_is_thinned_and_looks_the_same() -> None:
    """A wall in two colours, as measured by a depth camera: 13 points per pixel, of which four are drawn."""
    column, row = np.meshgrid(np.linspace(-1, 1, 380), np.linspace(-1, 1, 350))
    xyz = np.stack([column, row, 3 + 0.2 * column], axis=-1).reshape(-1, 3).astype(np.float32)
    rgb = np.where(xyz[:, :1] < 0.2, [[200, 40, 40]], [[40, 40, 200]]).astype(np.uint8)
    cloud = PointCloud(xyz, rgb)
    all_of = VIEW.model_copy(update={"points_per_px": 1000.0})
    for thin, full in zip(
        render_pairs(cloud, [np.eye(3)], VIEW), render_pairs(cloud, [np.eye(3)], all_of), strict=True
    ):
        assert np.shares_memory(thin.xyz_m, xyz) and len(thin.xyz_m) == len(cloud)
        assert thin.rgb.shape == full.rgb.shape
        np.testing.assert_allclose(thin.origin_m, full.origin_m, atol=thin.metres_per_px)
        assert (thin.rgb == full.rgb).all(axis=2).mean() > 0.97
    numbers = drawn_points(len(cloud), VIEW)
    assert numbers is not None
    assert len(numbers) == 4 * VIEW.size_px**2 < len(cloud)
    assert drawn_points(len(numbers), VIEW) is drawn_points(len(cloud), all_of) is None


def test_points_without_colour_are_shaded_by_depth_or_reflectance() -> None:
    points = np.array([[0, 0, 1], [1, 1, 3]], np.float32)
    by_depth = render_pairs(PointCloud(points), [np.eye(3)], VIEW)[0]
    assert by_depth.rgb[pixel_of(by_depth, points[0])][0] > by_depth.rgb[pixel_of(by_depth, points[1])][0]
    cloud = PointCloud(points, reflectance=np.array([0.0, 1.0], np.float32))
    shown = render_pairs(cloud, [np.eye(3)], VIEW)[0]
    assert shown.rgb[pixel_of(shown, points[0])][0] < shown.rgb[pixel_of(shown, points[1])][0]
    assert shown.rgb[0, -1, 0] == BACKGROUND
