"""Lines of sight: what hides what, and which points a sensor with larger cells would still measure."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from annotator.geometry.projection import pixel_rays
from annotator.geometry.sight_grid import SightGrid, kept_by_coarser
from annotator.types import Camera, Frame, PointCloud

CAMERA = Camera(80, 60, 80.0, 80.0, 39.5, 29.5)
RAYS = np.column_stack([pixel_rays(CAMERA).reshape(-1, 2), np.ones(80 * 60, np.float32)])
PIXELS = SightGrid(CAMERA, (1 / 80, 1 / 80))


def wall(depth_m: float, across: slice = slice(0, 80), down: slice = slice(0, 60), every: int = 1) -> np.ndarray:
    """One point per pixel, or per `every`-th one, of a part of a wall across the view."""
    return np.asarray((RAYS.reshape(60, 80, 3)[down, across][::every, ::every] * depth_m).reshape(-1, 3), np.float32)


def rings(depth_m: float, half_rad: float = 0.3) -> np.ndarray:
    """A wall as a LiDAR measures it: 0.002 rad between points, 0.008 rad between rings."""
    a, e = np.meshgrid(np.arange(-half_rad, half_rad, 0.002), np.arange(-0.2, 0.2, 0.008))
    return (np.stack([np.tan(a), np.tan(e) / np.cos(a), np.ones(a.shape)], -1).reshape(-1, 3) * depth_m).astype(
        np.float32
    )


@pytest.mark.parametrize("every", [1, 2, 4])
def test_a_surface_hides_what_is_behind_it_and_nothing_else(every: int) -> None:
    front, behind = wall(2.0, slice(20, 61), slice(10, 51), every), wall(3.0)
    hidden = PIXELS.hides(front, behind).reshape(60, 80)
    expected = np.zeros((60, 80), bool)
    expected[10:51, 20:61] = True
    assert (hidden == expected).mean() > 0.97  # at the edges, gaps are not closed
    assert not hidden[~expected].any()
    assert not PIXELS.hides(behind, front).any()
    assert not PIXELS.hides(front, front).any()


def test_two_surfaces_far_apart_do_not_hide_what_is_between_them() -> None:
    front = np.concatenate([wall(2.0, slice(0, 30)), wall(2.0, slice(50, 80))])
    assert not PIXELS.hides(front, wall(3.0, slice(33, 47))).any()


def test_points_behind_the_camera_neither_hide_nor_are_hidden() -> None:
    back = wall(2.0) * np.float32([1, 1, -1])
    assert not PIXELS.hides(back, wall(3.0)).any()
    assert not PIXELS.hides(wall(2.0), back).any()
    empty = np.zeros((0, 3), np.float32)
    assert PIXELS.hides(wall(2.0), empty).shape == (0,)
    assert not PIXELS.hides(empty, wall(2.0)).any()


def test_the_cells_of_a_lidar_are_estimated_from_its_points() -> None:
    image = np.zeros((60, 80, 3), np.uint8)
    lidar = SightGrid.of(Frame("0", 0, CAMERA, image, PointCloud(rings(10.0))))
    assert lidar.camera is None
    assert lidar.step_rad[0] == pytest.approx(0.002, rel=0.1)
    assert lidar.step_rad[1] == pytest.approx(0.008, rel=0.35)
    hidden = lidar.hides(rings(10.0, 0.1), rings(20.0))
    inside = np.abs(np.arctan2(rings(20.0)[:, 0], 20.0)) < 0.095
    assert hidden[inside].all()
    assert not hidden[np.abs(np.arctan2(rings(20.0)[:, 0], 20.0)) > 0.103].any()


def test_a_depth_camera_has_one_cell_per_pixel() -> None:
    image = np.zeros((60, 80, 3), np.uint8)
    cloud = PointCloud(wall(1.0), pixel_index=np.arange(4800, dtype=np.int32))
    grid = SightGrid.of(Frame("0", 0, CAMERA, image, cloud))
    assert grid.camera is CAMERA
    assert np.rint(grid.cells(cloud.xyz_m)).astype(int).tolist()[81] == [1, 1]


@settings(deadline=None, max_examples=50)
@given(st.floats(0.3, 4.0), st.floats(0.3, 4.0), st.floats(0, 1), st.floats(0, 1))
def test_a_coarser_sensor_keeps_whole_columns_and_rows(across: float, down: float, x: float, y: float) -> None:
    columns, rows = np.meshgrid(np.arange(100.0), np.arange(80.0))
    keep = kept_by_coarser(np.stack([columns.ravel(), rows.ravel()], 1), (across, down), (x, y)).reshape(80, 100)
    assert (keep == keep.any(axis=1)[:, None] & keep.any(axis=0)).all()
    assert keep.any(axis=0).sum() == pytest.approx(100 / max(across, 1), abs=1.01)
    assert keep.any(axis=1).sum() == pytest.approx(80 / max(down, 1), abs=1.01)
