"""Corners, containment and boxes around points."""

from __future__ import annotations

import numpy as np
import pytest
from geometry_strategies import boxes, random_boxes, rotations
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from annotator.geometry.oriented_box import (
    CORNER_SIGNS,
    MIN_SIDE_M,
    aligned_box,
    box_corners,
    contains,
    contains_parts,
)
from annotator.types import Box2D, OrientedBox
from annotator.types.errors import GeometryError


def test_corners_have_the_documented_order() -> None:
    names = ["".join("+" if sign > 0 else "-" for sign in row) for row in CORNER_SIGNS]
    assert names == ["---", "+--", "++-", "-+-", "--+", "+-+", "+++", "-++"]
    box = OrientedBox.from_parts(np.array([1.0, 2.0, 3.0]), np.eye(3), np.array([2.0, 4.0, 6.0]))
    np.testing.assert_allclose(box_corners(box)[[0, 1, 6]], [[0, 0, 0], [2, 0, 0], [2, 4, 6]])


@settings(deadline=None)
@given(boxes(), st.floats(0.5, 1.5), st.sampled_from([np.float32, np.float64]))
def test_corners_are_inside_an_enlarged_and_outside_a_shrunk_box(box: OrientedBox, scale: float, dtype: type) -> None:
    points = box_corners(box).astype(dtype)
    if abs(scale - 1.0) < 1e-3:
        return
    resized = contains_parts(box.center_m, box.rotation, box.size_m * scale, points)
    assert resized.all() if scale > 1 else not resized.any()


def test_margin_moves_every_face_outwards() -> None:
    box = OrientedBox.from_parts(np.zeros(3), np.eye(3), np.array([2.0, 4.0, 6.0]))
    points = np.array([[1.09, 0.0, 0.0], [0.0, 2.09, 0.0], [0.0, 0.0, -3.09], [1.09, 2.09, 3.09]])
    assert contains(box, points, margin_m=0.1).all()
    assert not contains(box, points).any()
    assert not contains(box, points, margin_m=0.08).any()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_nan_points_are_outside_and_an_empty_cloud_gives_an_empty_mask(dtype: type) -> None:
    box = OrientedBox.from_parts(np.zeros(3), np.eye(3), np.ones(3))
    assert contains(box, np.array([[np.nan, 0, 0], [0, 0, 0]], dtype)).tolist() == [False, True]
    assert contains(box, np.zeros((0, 3), dtype)).shape == (0,)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_point_is_inside_if_it_is_inside_along_each_axis(dtype: type) -> None:
    rng = np.random.default_rng(0)
    wide = rng.normal(size=(3000, 5)).astype(dtype)
    wide[::7, 1] = np.nan
    for points in (wide[:, :3].copy(), wide[:, :3], wide[::-2, :3]):
        for box in random_boxes(5, 1):
            along = (points.astype(np.float64) - box.center_m) @ box.rotation
            off = np.abs(np.abs(along) - box.size_m / 2).min(axis=1)
            expected = (np.abs(along) <= box.size_m / 2).all(axis=1)
            assert expected.any()
            clear = ~(off < 1e-5)  # the others are on the surface, up to rounding
            np.testing.assert_array_equal(contains(box, points)[clear], expected[clear])


MIRROR = np.diag([1.0, 1.0, -1.0])


@pytest.mark.parametrize(
    "rotation",
    [MIRROR, np.zeros((3, 3)), 1.01 * np.eye(3), 1e200 * np.eye(3), np.nan * np.eye(3), np.eye(3) + 0.01, -np.eye(3)],
    ids=["mirror", "zeros", "scaled", "huge", "NaN", "sheared", "point reflection"],
)
def test_a_matrix_that_is_not_a_rotation_is_refused(rotation: np.ndarray) -> None:
    with pytest.raises(ValueError, match="proper rotation matrix"):
        OrientedBox.from_parts(np.zeros(3), rotation, np.ones(3))


@settings(deadline=None)
@given(boxes(), st.integers(0, 2), st.integers(0, 2), st.floats(1e-9, 4e-4))
def test_a_matrix_that_is_nearly_a_rotation_becomes_one(box: OrientedBox, row: int, column: int, error: float) -> None:
    rotation = box.rotation.copy()
    rotation[row, column] += error
    made = OrientedBox.from_parts(box.center_m, rotation, box.size_m).rotation
    np.testing.assert_allclose(made.T @ made, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(made, rotation, atol=2 * error)


@pytest.mark.parametrize(
    ("center", "size"),
    [
        ([0, 0, np.nan], [1, 1, 1]),
        ([0, np.inf, 0], [1, 1, 1]),
        ([0, 0, 0], [1, 0, 1]),
        ([0, 0, 0], [np.nan, 1, 1]),
        ([-2e9, 0, 0], [1, 1, 1]),
        ([0, 0, 0], [1, 1, 2e9]),
    ],
)
def test_invalid_positions_and_sizes_are_refused(center: list[float], size: list[float]) -> None:
    with pytest.raises(ValueError, match=r"finite|positive|within"):
        OrientedBox.from_parts(np.array(center, float), np.eye(3), np.array(size, float))


@pytest.mark.parametrize("edges", [(0, 0, np.nan, 1), (0, -np.inf, 1, 1), (1, 0, 1, 1), (0, 2, 1, 1)])
def test_a_2d_box_with_non_finite_or_unordered_edges_is_refused(edges: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match=r"finite|positive width"):
        Box2D("thing", *map(float, edges))


def point_clouds() -> st.SearchStrategy[np.ndarray]:
    return hnp.arrays(np.float64, st.tuples(st.integers(5, 40), st.just(3)), elements=st.floats(-2.0, 2.0, width=16))


@settings(deadline=None, max_examples=50)
@given(point_clouds(), rotations())
def test_an_aligned_box_touches_the_points_on_every_side(points: np.ndarray, rotation: Rotation) -> None:
    found = aligned_box(points, rotation.as_matrix())
    np.testing.assert_allclose(found.rotation, rotation.as_matrix(), atol=1e-9)
    assert contains(found, points, 1e-9).all()
    extents = np.ptp(points @ rotation.as_matrix(), axis=0)
    np.testing.assert_allclose(found.size_m, np.maximum(extents, MIN_SIDE_M), atol=1e-9)


def test_an_aligned_box_has_a_minimum_size_and_needs_a_point() -> None:
    found = aligned_box(np.array([[1.0, 2.0, 3.0]]), np.eye(3))
    np.testing.assert_array_equal(found.size_m, MIN_SIDE_M)
    np.testing.assert_allclose(found.center_m, [1.0, 2.0, 3.0])
    with pytest.raises(GeometryError, match="at least 1 point"):
        aligned_box(np.zeros((0, 3)), np.eye(3))
