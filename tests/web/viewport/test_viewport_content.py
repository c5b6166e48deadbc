"""What a viewport shows: points, colours, lines of boxes and views, and picking."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from annotator.geometry.oriented_box import box_corners
from annotator.geometry.outline import box_on_image
from annotator.geometry.projection import project
from annotator.rcv.config import RcvConfig
from annotator.rcv.known_objects import first_views
from annotator.recordings import open_recording
from annotator.types import Box2D, Camera, Frame, OrientedBox, PointCloud
from annotator.web.viewport.drawing import (
    PointColor,
    frustum_lines,
    initial_camera,
    pick,
    placed_box_lines,
    point_colors,
    point_size_m,
    shown_points,
    view_placement,
)
from annotator.workflows.recorded.reading import load_truth


@pytest.fixture(scope="module")
def frame(generated: Path) -> Frame:
    return open_recording(generated / "people").frame(0)


@pytest.fixture(scope="module")
def truth(generated: Path, frame: Frame) -> OrientedBox:
    return load_truth(open_recording(generated / "people"), 0, frame)[0].box


def test_a_box_is_drawn_as_its_edges_and_an_arrow_through_its_front(truth: OrientedBox) -> None:
    lines = placed_box_lines(truth)
    assert lines.shape == (21, 2, 3)
    corners = box_corners(truth)
    ends = lines[:12].reshape(-1, 3)
    nearest = np.linalg.norm(ends[:, None] - corners, axis=2)
    assert nearest.min(axis=1).max() < 1e-5
    np.testing.assert_array_equal(np.bincount(nearest.argmin(axis=1)), np.full(8, 3))
    # in the box's own axes: from the middle of the top; the head begins in front of the front face
    shaft, head = ((part - truth.center_m) @ truth.rotation for part in (lines[12], lines[13:]))
    mean_m, top_m, front_m = truth.size_m.mean(), truth.size_m[2] / 2, truth.size_m[0] / 2
    tip = [front_m + 0.4 * mean_m, 0, top_m]
    np.testing.assert_allclose(shaft, [[0, 0, top_m], tip], atol=1e-5)
    np.testing.assert_allclose(head[:4, 0], [tip] * 4, atol=1e-5)
    corners = head[:4, 1]
    np.testing.assert_allclose(corners[:, 0], front_m + 0.08 * mean_m, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(corners[:, 1:] - [0, top_m], axis=1), 0.13 * mean_m, atol=1e-5)
    np.testing.assert_allclose(head[4:], np.stack([corners, np.roll(corners, -1, axis=0)], axis=1), atol=1e-5)


@pytest.mark.parametrize("distortion", [(), (0.08, -0.1, 0.001, -0.002, 0.02)])
def test_the_frustum_projects_onto_the_image_box(frame: Frame, distortion: tuple[float, ...]) -> None:
    camera = frame.camera
    bent = Camera(camera.width_px, camera.height_px, camera.fx, camera.fy, camera.cx, camera.cy, distortion)
    seen = Frame("0", 0, bent, frame.rgb, frame.cloud)
    box = Box2D("person", 40.0, 30.0, 200.0, 180.0)
    lines = frustum_lines(seen, box)
    px = project(bent, lines[:4, 1])
    corners = np.array([[40, 30], [200, 30], [200, 180], [40, 180]])
    np.testing.assert_allclose(px, corners, atol=0.05)
    np.testing.assert_array_equal(lines[:4, 0], 0)
    border = project(bent, lines[4:, 0])
    on_edge = np.abs(border[:, [0, 0, 1, 1]] - [40, 200, 30, 180]).min(axis=1)
    assert on_edge.max() < 0.05


def test_a_view_is_placed_in_front_of_its_points_with_each_pixel_in_place(frame: Frame, truth: OrientedBox) -> None:
    image_box = box_on_image(frame.camera, truth, "person")
    assert image_box is not None
    views = first_views(frame, image_box, RcvConfig())
    assert views is not None
    for view in views:
        place = view_placement(view)
        right, down, into = place.R_camera_view.T
        np.testing.assert_allclose([right, down, into], view.axes, atol=1e-12)
        assert (view.xyz_m @ into).min() > place.center_m @ into
        # the centre of pixel (0, 0), computed from the placement's size and from the view's origin
        height_px, width_px = view.rgb.shape[:2]
        half = 0.5 * place.size_m * (1 - 1 / np.array([width_px, height_px]))
        corner = place.center_m - half[0] * right - half[1] * down
        np.testing.assert_allclose([corner @ right, corner @ down], view.origin_m, atol=1e-9)
        along = place.looks_at_m - place.seen_from_m
        np.testing.assert_allclose(along / np.linalg.norm(along), into, atol=1e-9)


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


@pytest.mark.parametrize("what", ["nothing", "rgb", "reflectance", "empty"])
def test_every_cloud_has_every_kind_of_colour(what: str) -> None:
    rng, n = np.random.default_rng(0), 0 if what == "empty" else 50
    rgb = rng.integers(0, 256, (n, 3)).astype(np.uint8) if what == "rgb" else None
    reflectance = rng.random(n).astype(np.float32) if what == "reflectance" else None
    cloud = frame_of(rng.normal(0, 1, (n, 3)) + np.array([0, 0, 5]), rgb, reflectance).cloud
    for color in PointColor:
        colors = point_colors(cloud, color, UP)
        assert (colors.shape, colors.dtype) == ((n, 3), np.uint8)


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


unit = st.floats(-1, 1)


def box_at(z_m: float, size: float = 1.0, turn: tuple[float, float, float] = (0, 0, 0)) -> OrientedBox:
    return OrientedBox.from_parts(
        np.array([0, 0, z_m]), Rotation.from_rotvec(turn).as_matrix(), np.array([size, size, size])
    )


AHEAD = np.array([0.0, 0.0, 1.0])
ORIGIN = np.zeros(3)


def test_the_nearest_box_on_the_ray_is_picked() -> None:
    boxes = [box_at(9), box_at(3), box_at(6), box_at(-3)]
    assert pick(boxes, ORIGIN, AHEAD) == 1
    assert pick(boxes, ORIGIN, -AHEAD) == 3
    assert pick(boxes, ORIGIN, np.array([1.0, 0, 0])) is None
    # boxes around the ray's origin come last
    assert pick([box_at(0, 20), box_at(3)], ORIGIN, AHEAD) == 1
    assert pick([box_at(0, 20), box_at(0, 2)], ORIGIN, AHEAD) == 1


@given(st.tuples(unit, unit, unit), st.tuples(unit, unit, unit), st.tuples(unit, unit, unit))
def test_a_ray_to_a_point_in_a_box_meets_it(turn: tuple, inside: tuple, start: tuple) -> None:
    box = box_at(5, 1.0, turn)
    target = box.T_camera_box.apply(0.49 * np.array(inside))
    origin = np.array(start)
    assert pick([box], origin, target - origin) == 0


@given(st.tuples(unit, unit, unit), st.floats(0.05, 1), st.sampled_from(range(3)))
def test_a_ray_beside_a_box_misses_it(turn: tuple, beside: float, axis: int) -> None:
    box = box_at(5, 1.0, turn)
    off, along = np.roll(np.eye(3), axis, axis=0)[:2]
    start = box.T_camera_box.apply((0.5 + beside) * off - 4 * along)
    assert pick([box], start, box.rotation @ along) is None
