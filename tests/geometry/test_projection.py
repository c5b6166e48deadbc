"""Pixels, rays, depth images, and outlines of boxes on images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from geometry_strategies import boxes, cameras
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from annotator.geometry.oriented_box import EDGES, box_corners
from annotator.geometry.outline import (
    NEAR_M,
    Sight,
    box_on_image,
    points_on_image,
    rectangle_intersection_pairs,
    visible_edges,
)
from annotator.geometry.projection import (
    distort,
    in_frustum,
    in_metres,
    pixel_rays,
    project,
    radius_limit_squared,
    straightened,
    undistort,
    unproject_depth,
)
from annotator.types import Box2D, Camera, OrientedBox

PINHOLE = Camera(640, 480, 500.0, 510.0, 319.5, 239.5)


def depth_image(camera: Camera, seed: int, holes: bool = True) -> np.ndarray:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.3, 8.0, (camera.height_px, camera.width_px)).astype(np.float32)
    if holes:
        depth[rng.random(depth.shape) < 0.2] = 0.0
        depth[rng.random(depth.shape) < 0.1] = np.nan
    return depth


@settings(deadline=None)
@given(cameras(), st.integers(0, 1000))
def test_project_of_unproject_is_the_pixel(camera: Camera, seed: int) -> None:
    depth = depth_image(camera, seed)
    xyz, pixel = unproject_depth(camera, depth)
    assert xyz.dtype == np.float32
    np.testing.assert_array_equal(pixel, np.flatnonzero(depth > 0))
    np.testing.assert_array_equal(xyz[:, 2], depth.reshape(-1)[pixel])
    v, u = np.divmod(pixel, camera.width_px)
    np.testing.assert_allclose(project(camera, xyz), np.stack([u, v], axis=1), atol=1e-3)


@settings(deadline=None)
@given(cameras())
def test_project_agrees_with_opencv(camera: Camera) -> None:
    xyz = np.random.default_rng(0).uniform(-1, 1, (50, 3)) * [1.0, 0.8, 0.5] + [0.0, 0.0, 2.5]
    coefficients = np.array(camera.distortion) if camera.distortion else None
    want = cv2.projectPoints(xyz, np.zeros(3), np.zeros(3), camera.matrix, coefficients)[0][:, 0]
    np.testing.assert_allclose(project(camera, xyz), want, atol=1e-9)


def test_the_centre_of_the_first_pixel_is_0_0() -> None:
    """The pixel convention: the ray K^-1 (0, 0, 1) projects to (0, 0), and the image's corner is at -0.5."""
    ray = np.linalg.inv(PINHOLE.matrix) @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(project(PINHOLE, 3.0 * ray[None]), [[0.0, 0.0]], atol=1e-12)
    depth = np.zeros((480, 640), np.float32)
    depth[0, 0] = 2.0
    xyz, pixel = unproject_depth(PINHOLE, depth)
    np.testing.assert_allclose(xyz, 2.0 * ray[None], rtol=1e-6)
    assert pixel.tolist() == [0]


@pytest.mark.parametrize("point", [(0.0, 0.0, 0.0), (1.0, 0.0, -2.0), (0.0, 0.0, np.nan), (np.nan, 0.0, 1.0)])
@pytest.mark.parametrize("distortion", [(), (0.1, 0.0, 0.0, 0.0)])
def test_points_behind_the_camera_have_no_pixel(point: tuple[float, ...], distortion: tuple[float, ...]) -> None:
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0, distortion)
    both = project(camera, np.array([point, (0.0, 0.0, 1.0)]))
    assert np.isnan(both[0]).any()
    np.testing.assert_allclose(both[1], [320.0, 240.0])


def test_a_point_beyond_the_lens_models_range_is_not_folded_back_into_the_image() -> None:
    camera = Camera(640, 480, 400.0, 400.0, 320.0, 240.0, (-0.3, 0.0, 0.0, 0.0))
    far_aside = np.array([[1.8, 0.0, 1.0]])
    folded = cv2.projectPoints(far_aside, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion))[0]
    assert 0 < folded[0, 0, 0] < 640
    assert np.isnan(project(camera, far_aside)).all()


def test_strong_barrel_distortion_is_inverted_up_to_its_turning_point() -> None:
    barrel = (-0.3, 0.0, 0.0, 0.0)
    # r - 0.3 r^3 grows up to r^2 = 1 / 0.9
    assert radius_limit_squared(barrel) == pytest.approx(1 / 0.9)
    assert np.isfinite(distort(barrel, np.array([[1.0, 0.0]]))).all()
    assert np.isnan(distort(barrel, np.array([[3.0, 0.0]]))).all()
    near_limit = np.array([[1.04, 0.0], [0.0, -1.05]])
    np.testing.assert_allclose(undistort(barrel, distort(barrel, near_limit)), near_limit, atol=1e-6)
    assert np.isnan(undistort(barrel, np.array([[1.5, 0.0]]))).all()
    # pixels beyond have no point
    camera = Camera(64, 48, 25.0, 25.0, 31.5, 23.5, barrel)
    xyz, pixel = unproject_depth(camera, np.ones((48, 64), np.float32))
    assert 0 < len(xyz) < 64 * 48 and np.isfinite(xyz).all() and 0 not in pixel


INF, NAN = float("inf"), float("nan")
TABLE = [
    ("u2", [0, 1, 2000, 65503, 65504, 65535], [0, 1, 2000, 65503, 0, 0]),
    ("i2", [-1, 0, 2000, 32767, -32768], [0, 0, 2000, 0, 0]),
    ("i4", [-5, 2000, 65535, 70000, 2**31 - 1], [0, 2000, 0, 70000, 0]),
    ("f2", [-1, NAN, INF, 65504, 2000], [0, 0, 0, 0, 2000]),
    ("f4", [-INF, NAN, INF, -2, 65504, 65535, 2000.5], [0, 0, 0, 0, 0, 0, 2000.5]),
    ("f8", [NAN, 65535, 3], [0, 0, 3]),
]


@pytest.mark.parametrize("units_per_m", [1.0, 1000.0, 5000.0])
@pytest.mark.parametrize(("kind", "raw", "units"), TABLE)
def test_depths_in_metres(kind: str, raw: list[float], units: list[float], units_per_m: float):
    for order in "<>":
        depth_m = in_metres(np.array([raw], order + kind), units_per_m)
        np.testing.assert_array_equal(depth_m, np.array([units], np.float32) / np.float32(units_per_m))
        assert depth_m.dtype == np.float32


@settings(deadline=None)
@given(cameras())
def test_the_frustum_of_a_box_contains_exactly_the_pixels_inside(camera: Camera) -> None:
    depth = np.random.default_rng(0).uniform(0.5, 5.0, (camera.height_px, camera.width_px)).astype(np.float32)
    xyz, pixel = unproject_depth(camera, depth)
    inside = in_frustum(camera, xyz, Box2D("x", 9.5, 4.5, 30.5, 20.5))
    v, u = np.divmod(pixel, camera.width_px)
    np.testing.assert_array_equal(inside, (u >= 10) & (u <= 30) & (v >= 5) & (v <= 20))


PIXELS = pixel_rays(Camera(40, 40, 40.0, 40.0, 19.5, 19.5)).reshape(-1, 2)
BOX = OrientedBox.from_parts(np.array([0.0, 0.0, 5.0]), np.eye(3), np.array([2.0, 2.0, 2.0]))


def points(depth_m: np.ndarray) -> np.ndarray:
    return (np.column_stack([PIXELS, np.ones(len(PIXELS))]) * depth_m[:, None]).astype(np.float32)


@pytest.mark.parametrize(
    ("left_m", "right_m", "margin_m", "share"),
    [
        (4.0, 4.0, 0.0, 0.0),  # the box's own front, up to rounding
        (4.5, 9.0, 0.0, 0.0),  # points inside the box, and a wall seen through it
        (2.0, 9.0, 0.0, 0.5),
        (2.0, 3.9, 0.2, 0.5),
        (2.0, 3.9, 0.05, 1.0),
    ],
)
def test_nearer_points_hide_a_box(left_m: float, right_m: float, margin_m: float, share: float) -> None:
    depth = np.where(PIXELS[:, 0] < 0, left_m, right_m) * 1.000001
    hidden = Sight(points(depth)).hidden(BOX, margin_m)
    assert hidden.rays == 400  # 20 x 20 pixels: the front face is 2 m at 4 m
    assert hidden.share == pytest.approx(share)


def test_a_box_around_the_camera_is_not_hidden() -> None:
    around = OrientedBox.from_parts(np.zeros(3), np.eye(3), np.full(3, 2.0))
    hidden = Sight(points(np.full(len(PIXELS), 0.5))).hidden(around)
    assert hidden.rays == len(PIXELS)
    assert hidden.share == 0.0


def test_an_undistorted_image_shows_points_where_the_ideal_camera_projects_them() -> None:
    lens = Camera(64, 48, 50.0, 50.0, 31.5, 23.5, (-0.2, 0.05, 0.001, 0.002))
    spot = np.array([[0.3, -0.2, 1.0]])
    u, v = np.rint(project(lens, spot)[0]).astype(int)
    rgb = np.zeros((48, 64, 3), np.uint8)
    rgb[v - 1 : v + 2, u - 1 : u + 2] = (10, 200, 30)
    ideal, straight = straightened(lens, rgb)
    assert ideal.is_ideal
    assert (ideal.fx, ideal.cx, ideal.width_px) == (lens.fx, lens.cx, lens.width_px)
    u, v = np.rint(project(ideal, spot)[0]).astype(int)
    np.testing.assert_array_equal(straight[v, u], (10, 200, 30))
    assert straightened(ideal, straight) == (ideal, straight)


CAMERA = Camera(200, 160, 150.0, 150.0, 99.5, 79.5)
DISTORTED = Camera(200, 160, 150.0, 150.0, 99.5, 79.5, (-0.2, 0.03, 0.001, -0.001))
# a lens model that folds back within the image: its corners have no ray
FOLDING = Camera(200, 160, 150.0, 150.0, 99.5, 79.5, (-0.5, 0.0, 0.0, 0.0))


def straight_box(center: tuple[float, ...], size: tuple[float, ...]) -> OrientedBox:
    return OrientedBox.from_parts(np.array(center), np.eye(3), np.array(size))


def surface_px(camera: Camera, box: OrientedBox, steps: int = 41) -> np.ndarray:
    """Samples of the box's surface in front of the camera, as pixels within the image."""
    a, b = (grid.reshape(-1) for grid in np.meshgrid(*[np.linspace(-1, 1, steps)] * 2))
    local = [np.roll(np.column_stack([np.full(len(a), side), a, b]), k, 1) for k in range(3) for side in (-1.0, 1.0)]
    xyz = box.T_camera_box.apply(np.concatenate(local) * box.size_m / 2)
    xyz = xyz[xyz[:, 2] >= NEAR_M]
    if not camera.is_ideal:  # where the lens model holds
        xyz = xyz[np.hypot(xyz[:, 0], xyz[:, 1]) < 1.0 * xyz[:, 2]]
    if len(xyz) == 0:
        return np.empty((0, 2))
    px = cv2.projectPoints(xyz, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion))[0][:, 0]
    return px[((px >= -0.5) & (px <= [camera.width_px - 0.5, camera.height_px - 0.5])).all(axis=1)]


@settings(deadline=None)
@given(boxes(2.0), cameras((200, 160)))
def test_the_2d_box_is_the_extent_of_the_visible_part(box: OrientedBox, camera: Camera) -> None:
    """Also for boxes beside, behind and around the camera."""
    px = surface_px(camera, box)
    found = box_on_image(camera, box, "thing", 1e-6)
    if len(px) == 0:
        # the samples are 3 cm apart, which is far apart on the image near the camera
        assert found is None or min(found.width_px, found.height_px) < 70
        return
    assert found is not None and found.label == "thing"
    low, high = px.min(axis=0), px.max(axis=0)
    got = np.array(found.xyxy)
    assert (got[:2] <= low + 0.1).all()
    assert (got[2:] >= high - 0.1).all()
    assert (got[:2] >= -0.5).all()
    assert (got[2:] <= [199.5, 159.5]).all()
    if (box.center_m[2] - np.linalg.norm(box.size_m) / 2) > 0.5:
        np.testing.assert_allclose(got, np.concatenate([low, high]), atol=12.0)


@pytest.mark.parametrize("center", [(0.0, 0.0, -3.0), (9.0, 0.0, 3.0), (0.0, -9.0, 3.0), (30.0, 0.0, 0.2)], ids=str)
@pytest.mark.parametrize("camera", [CAMERA, DISTORTED, FOLDING], ids=["ideal", "distorted", "folding"])
def test_objects_outside_the_image_have_no_box(camera: Camera, center: tuple[float, ...]) -> None:
    assert box_on_image(camera, straight_box(center, (1.0, 1.0, 1.0)), "thing") is None


def test_the_2d_box_ends_where_the_lens_model_folds_back() -> None:
    # the model is valid up to 0.816 off the axis, which is at 0.544 on the image: 81.6 px from its centre
    found = box_on_image(FOLDING, straight_box((2.0, 0.0, 2.0), (4.0, 0.2, 0.1)), "bar")
    assert found is not None
    assert found.x_min == pytest.approx(99.5, abs=0.01)
    assert 99.5 + 81.0 < found.x_max < 99.5 + 81.7


def test_2d_boxes_below_the_minimum_size_are_dropped() -> None:
    far = straight_box((0.0, 0.0, 100.0), (1.0, 1.0, 1.0))
    assert box_on_image(CAMERA, far, "far") is None
    small = box_on_image(CAMERA, far, "far", 1.0)
    assert small is not None and small.width_px == pytest.approx(150 / 99.5)


def test_the_2d_box_of_points_contains_those_on_the_image() -> None:
    xyz = np.array([[0.0, 0.0, 2.0], [0.4, 0.2, 2.0], [5.0, 0.0, 2.0], [0.0, 0.0, -2.0], [0.0, 0.02, 0.05]], np.float32)
    found = points_on_image(CAMERA, xyz, "a")
    assert found is not None and found.xyxy == pytest.approx((99.5, 79.5, 129.5, 94.5), abs=1e-4)
    assert points_on_image(CAMERA, xyz[2:], "a") is None
    assert points_on_image(CAMERA, xyz[:1], "a") is None


EDGE_CAMERA = Camera(640, 480, 500.0, 510.0, 320.0, 235.0)
EDGE_DISTORTED = Camera(640, 480, 500.0, 510.0, 320.0, 235.0, (-0.28, 0.09, 0.001, -0.0005, -0.012))


def box_at(x: float, y: float, z: float, size: float = 1.0, turn: float = 0.4) -> OrientedBox:
    rotation = Rotation.from_euler("xyz", [0.2, turn, -0.3]).as_matrix()
    return OrientedBox.from_parts(np.array([x, y, z]), rotation, np.array([size, 0.6 * size, 0.4 * size]))


@pytest.mark.parametrize("camera", [EDGE_CAMERA, EDGE_DISTORTED])
@pytest.mark.parametrize(
    "place", [(0.0, 0.0, 3.0), (1.7, 0.2, 3.0), (-0.9, 0.8, 2.0), (0.0, 0.0, 0.4), (0.3, 0.1, 0.2)]
)
def test_the_visible_edges_stay_within_the_2d_box(camera: Camera, place: tuple[float, float, float]) -> None:
    box = box_at(*place)
    (pieces,) = visible_edges(camera, [box])
    spanned = box_on_image(camera, box, "x")
    assert spanned is not None
    inside = pieces.reshape(-1, 2).clip([-0.5, -0.5], [639.5, 479.5])
    # a face may extend beyond the visible edges, but no edge beyond the faces
    assert (inside.min(axis=0) >= np.array(spanned.xyxy[:2]) - 0.1).all()
    assert (inside.max(axis=0) <= np.array(spanned.xyxy[2:]) + 0.1).all()
    assert np.isfinite(pieces).all()


def test_invisible_boxes_have_no_edges_and_the_order_is_kept() -> None:
    behind, beside, shown = box_at(0, 0, -3.0), box_at(30.0, 0, 3.0), box_at(0, 0, 4.0)
    found = visible_edges(EDGE_CAMERA, [behind, shown, beside])
    assert [len(pieces) for pieces in found] == [0, 12, 0]
    assert np.allclose(found[1], project(EDGE_CAMERA, box_corners(shown))[np.array(EDGES)], atol=1e-6)
    assert visible_edges(EDGE_CAMERA, []) == []


@pytest.mark.parametrize(
    ("yaw", "center", "expected"),
    [(0.0, (0.5, 0.0), 0.5), (np.pi / 4, (0.0, 0.0), 2 * (2**0.5 - 1)), (0.3, (2.0, 0.0), 0.0)],
    ids=["shifted", "an octagon", "apart"],
)
def test_areas_of_rectangles_that_overlap_a_unit_square(
    yaw: float, center: tuple[float, float], expected: float
) -> None:
    unit = (np.zeros((1, 2)), np.zeros(1), np.ones((1, 2)))
    other = (np.array([center]), np.array([yaw]), np.ones((1, 2)))
    assert rectangle_intersection_pairs(*unit, *other)[0] == pytest.approx(expected, abs=1e-9)
