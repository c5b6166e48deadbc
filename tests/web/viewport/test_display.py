"""The shown points of a cloud, their colours and size, and the initial camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from annotator.recordings import open_recording
from annotator.types import Camera, Frame, PointCloud
from annotator.web.viewport.drawing import PointColor, initial_camera, point_colors, point_size_m, shown_points

UP = np.array([0.0, -1.0, 0.0])


def frame_of(xyz: np.ndarray, rgb: np.ndarray | None = None, reflectance: np.ndarray | None = None) -> Frame:
    camera = Camera(8, 6, 10.0, 10.0, 3.5, 2.5)
    cloud = PointCloud(xyz.astype(np.float32), rgb, reflectance)
    return Frame("0", 0, camera, np.zeros((6, 8, 3), np.uint8), cloud)


def test_a_thinned_point_keeps_its_own_colour() -> None:
    n = 1000
    xyz = np.column_stack([np.arange(n), np.zeros(n), np.ones(n)])
    rgb = np.column_stack([np.arange(n) % 256, np.arange(n) // 256, np.zeros(n)]).astype(np.uint8)
    shown = shown_points(frame_of(xyz, rgb), 100)
    assert len(shown) == 100
    colors = point_colors(shown, PointColor.RGB, UP).astype(int)
    np.testing.assert_array_equal(colors[:, 0] + 256 * colors[:, 1], shown.xyz_m[:, 0].astype(int))


@pytest.mark.parametrize("color", PointColor)
@pytest.mark.parametrize("what", ["nothing", "rgb", "reflectance", "both", "empty"])
def test_every_cloud_has_every_kind_of_colour(color: PointColor, what: str) -> None:
    n = 0 if what == "empty" else 50
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (n, 3)).astype(np.uint8) if what in ("rgb", "both") else None
    reflectance = rng.random(n).astype(np.float32) if what in ("reflectance", "both") else None
    cloud = frame_of(rng.normal(0, 1, (n, 3)) + np.array([0, 0, 5]), rgb, reflectance).cloud
    colors = point_colors(cloud, color, UP)
    assert colors.shape == (n, 3)
    assert colors.dtype == np.uint8


def test_height_colours_depend_only_on_the_height() -> None:
    height = np.linspace(0, 2, 100)
    low_to_high = frame_of(np.column_stack([np.zeros(100), -height, np.full(100, 4)])).cloud
    colors = point_colors(low_to_high, PointColor.HEIGHT, UP).astype(int)
    assert colors[0, 2] > colors[0, 0]  # low: blue
    assert colors[-1, 0] > colors[-1, 2]  # high: red
    moved = frame_of(low_to_high.xyz_m + np.array([3.0, 0, 5.0])).cloud
    np.testing.assert_array_equal(point_colors(moved, PointColor.HEIGHT, UP), colors)


@given(st.floats(1, 60))
def test_point_size_and_initial_camera_scale_with_the_scene(distance_m: float) -> None:
    rng = np.random.default_rng(1)
    xyz = rng.normal(0, 0.1, (500, 3)) + np.array([0, 0, 1])
    unit, scaled = frame_of(xyz), frame_of(xyz * distance_m)
    assert point_size_m(scaled.cloud, 500) == pytest.approx(distance_m * point_size_m(unit.cloud, 500), rel=1e-3)
    np.testing.assert_allclose(initial_camera(scaled).position, distance_m * initial_camera(unit).position, rtol=1e-3)


def test_points_of_a_thinned_cloud_are_larger() -> None:
    """The surfaces of a thinned dense cloud stay closed; a sparse scan has no closed surfaces."""
    cloud = frame_of(np.random.default_rng(1).normal(0, 0.1, (500, 3)) + np.array([0, 0, 1])).cloud
    assert point_size_m(cloud, 50_000) > point_size_m(cloud, 500)


def test_the_initial_camera_is_behind_the_camera_and_looks_along_its_axis(generated: Path) -> None:
    recording = open_recording(generated / "people")
    frame = recording.frame(0)
    camera = initial_camera(frame)
    assert camera.position[2] < 0
    assert camera.position @ camera.up > 0  # above it
    np.testing.assert_array_equal(camera.look_at[:2], 0)
    assert np.percentile(frame.cloud.xyz_m[:, 2], 20) < camera.look_at[2] < np.percentile(frame.cloud.xyz_m[:, 2], 80)
    assert frame.up is not None
    np.testing.assert_array_equal(camera.up, frame.up)
