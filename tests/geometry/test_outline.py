"""2D boxes of 3D boxes and of points, against dense samples of the surface and OpenCV's projection."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from geometry_strategies import boxes, cameras
from hypothesis import given, settings
from scipy.spatial.transform import Rotation

from annotator.geometry.oriented_box import EDGES, box_corners
from annotator.geometry.outline import (
    NEAR_M,
    box_on_image,
    points_on_image,
    rectangle_intersection_pairs,
    visible_edges,
)
from annotator.geometry.projection import project
from annotator.types import Camera, OrientedBox

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
