"""Corners, containment, directions and axes of boxes, boxes around points, and IoUs."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from geometry_strategies import boxes, random_boxes, rotations, vectors
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import (
    intersection_volume_pairs,
    iou_3d,
    iou_3d_matrix,
    nms_3d,
)
from annotator.geometry.oriented_box import (
    CORNER_SIGNS,
    MIN_SIDE_M,
    aligned_box,
    box_corners,
    common_axis,
    contains,
    corrected,
    nearest_upright,
    tightest_box,
)
from annotator.geometry.projection import project, unproject_depth
from annotator.geometry.transforms import right_handed_axes, unit
from annotator.rcv.rotations import free_grid, yaw_grid
from annotator.types import Box2D, Camera, Correction, Frame, OrientedBox, PointCloud
from annotator.types.errors import GeometryError


def test_corners_have_the_documented_order() -> None:
    names = ["".join("+" if sign > 0 else "-" for sign in row) for row in CORNER_SIGNS]
    assert names == ["---", "+--", "++-", "-+-", "--+", "+-+", "+++", "-++"]
    box = OrientedBox.from_parts(np.array([1.0, 2.0, 3.0]), np.eye(3), np.array([2.0, 4.0, 6.0]))
    np.testing.assert_allclose(box_corners(box)[[0, 1, 6]], [[0, 0, 0], [2, 0, 0], [2, 4, 6]])


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
            assert not contains(box, points)[np.isnan(points).any(axis=1)].any()
    assert contains(box, wide[:0, :3]).shape == (0,)


@pytest.mark.parametrize(
    ("center", "rotation", "size", "says"),
    [
        ((0, 0, 0), np.diag([1.0, 1.0, -1.0]), (1, 1, 1), "proper rotation matrix"),
        ((0, 0, 0), np.zeros((3, 3)), (1, 1, 1), "proper rotation matrix"),
        ((0, 0, 0), 1.01 * np.eye(3), (1, 1, 1), "proper rotation matrix"),
        ((0, 0, 0), np.nan * np.eye(3), (1, 1, 1), "proper rotation matrix"),
        ((0, 0, np.nan), np.eye(3), (1, 1, 1), "finite"),
        ((0, 0, 0), np.eye(3), (1, 0, 1), "positive"),
        ((-2e9, 0, 0), np.eye(3), (1, 1, 1), "within"),
    ],
    ids=["mirror", "zeros", "scaled", "no rotation", "no place", "flat", "far"],
)
def test_what_is_no_box_is_refused(
    center: tuple[float, ...], rotation: np.ndarray, size: tuple[float, ...], says: str
) -> None:
    with pytest.raises(ValueError, match=says):
        OrientedBox.from_parts(np.array(center, float), rotation, np.array(size, float))


@settings(deadline=None)
@given(boxes(), st.integers(0, 2), st.integers(0, 2), st.floats(1e-9, 4e-4))
def test_a_matrix_that_is_nearly_a_rotation_becomes_one(box: OrientedBox, row: int, column: int, error: float) -> None:
    rotation = box.rotation.copy()
    rotation[row, column] += error
    made = OrientedBox.from_parts(box.center_m, rotation, box.size_m).rotation
    np.testing.assert_allclose(made.T @ made, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(made, rotation, atol=2 * error)


@pytest.mark.parametrize("edges", [(0, 0, np.nan, 1), (0, -np.inf, 1, 1), (1, 0, 1, 1), (0, 2, 1, 1)])
def test_a_2d_box_with_non_finite_or_unordered_edges_is_refused(edges: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match=r"finite|positive width"):
        Box2D("thing", *map(float, edges))


def point_clouds() -> st.SearchStrategy[np.ndarray]:
    return hnp.arrays(np.float64, st.tuples(st.integers(5, 40), st.just(3)), elements=st.floats(-2.0, 2.0, width=16))


@settings(deadline=None)
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


UP = np.array([0.0, -1.0, 0.0])
SIZE = np.array([4.0, 1.8, 1.5])
CENTER = np.array([1.0, 2.0, 15.0])


def upright(yaw: float) -> np.ndarray:
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, sin, 0.0], [0.0, 0.0, -1.0], [-sin, cos, 0.0]])


def angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(Rotation.from_matrix(a.T @ b).magnitude())


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.7))
def test_no_other_upright_rotation_is_nearer(seed: int, lean: float) -> None:
    rng = np.random.default_rng(seed)
    about = rng.normal(size=3)
    about /= np.linalg.norm(about)
    R = Rotation.from_rotvec(about * lean).as_matrix() @ upright(rng.uniform(-np.pi, np.pi))
    found, tilt = nearest_upright(OrientedBox.from_parts(CENTER, R, SIZE), UP)
    np.testing.assert_allclose(found.rotation[:, 2], UP, atol=1e-9)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    assert angle(R, found.rotation) == pytest.approx(tilt, abs=1e-6)
    every = min(angle(R, upright(yaw)) for yaw in np.linspace(-np.pi, np.pi, 361))
    assert tilt <= every + 1e-6
    assert every <= tilt + np.deg2rad(1.0)
    np.testing.assert_array_equal(found.size_m, SIZE)


@pytest.mark.parametrize("roll", [np.pi / 2, -np.pi / 2])
def test_a_box_that_lies_on_its_side_keeps_its_length(roll: float) -> None:
    """Rotated about its length: height and width are swapped."""
    R = upright(0.4) @ Rotation.from_rotvec([roll, 0.0, 0.0]).as_matrix()
    box = OrientedBox.from_parts(CENTER, R, SIZE)
    found, tilt = nearest_upright(box, UP)
    assert tilt < 1e-7 and iou_3d(found, box) == pytest.approx(1.0)
    np.testing.assert_allclose(found.size_m, [4.0, 1.5, 1.8])
    np.testing.assert_allclose(np.abs(found.rotation[:, 0] @ R[:, 0]), 1.0)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2, 1.4])
def test_a_box_that_stands_on_end_has_its_length_as_height(pitch: float) -> None:
    R = upright(0.4) @ Rotation.from_rotvec([0.0, pitch, 0.0]).as_matrix()
    found, tilt = nearest_upright(OrientedBox.from_parts(CENTER, R, SIZE), UP)
    assert tilt == pytest.approx(abs(abs(pitch) - np.pi / 2), abs=1e-6)
    assert found.size_m[2] == 4.0
    np.testing.assert_allclose(found.rotation[:, 2], UP, atol=1e-9)


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


CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
TURN = Correction((0.02, -0.03, 0.01), (0.05, -0.02, 0.1))


@pytest.fixture
def frame() -> Frame:
    """A slanted plane with a coloured image."""
    depth = (2 + np.linspace(0, 1, 64)[None] * np.ones((48, 1))).astype(np.float32)
    xyz, pixel = unproject_depth(CAMERA, depth)
    rgb = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    cloud = PointCloud(xyz, rgb.reshape(-1, 3)[pixel], pixel_index=pixel)
    return Frame("0", 0, CAMERA, rgb, cloud, depth, np.array([0.0, -1.0, 0.0]))


def test_points_normals_and_up_move_with_the_cloud(frame: Frame):
    T = TURN.T_camera_recorded
    moved = corrected(frame, TURN)
    assert np.allclose(moved.cloud.xyz_m, T.apply(frame.cloud.xyz_m), atol=1e-6)
    assert moved.depth_m is None and moved.cloud.pixel_index is None, "the depth image is no longer registered"
    assert moved.up is not None
    assert np.allclose(moved.up, T.rotation.apply([0.0, -1.0, 0.0]))
    assert moved.cloud.normals is not None
    known = np.linalg.norm(moved.cloud.normals, axis=1) > 0.5
    # the normals of the plane, turned
    assert known.mean() > 0.8
    plane = np.cross(np.subtract(*moved.cloud.xyz_m[[70, 60]]), np.subtract(*moved.cloud.xyz_m[[640, 0]]))
    cosine = np.abs(moved.cloud.normals[known] @ plane / np.linalg.norm(plane))
    assert np.median(cosine) > 0.99


def test_points_take_the_colour_of_the_pixel_on_which_they_fall(frame: Frame):
    moved = corrected(frame, Correction(shift_m=(0.1, 0.0, 0.0)))
    px = project(CAMERA, moved.cloud.xyz_m).round().astype(int)
    inside = (px[:, 0] >= 0) & (px[:, 0] < 64) & (px[:, 1] >= 0) & (px[:, 1] < 48)
    assert moved.cloud.rgb is not None
    assert frame.cloud.rgb is not None
    assert (moved.cloud.rgb[inside] == frame.rgb[px[inside, 1], px[inside, 0]]).all()
    assert (moved.cloud.rgb[~inside] == frame.cloud.rgb[~inside]).all()
    assert not (moved.cloud.rgb == frame.cloud.rgb).all()


def standing(up: np.ndarray, turns: np.ndarray, lean_deg: float, seed: int) -> np.ndarray:
    """Boxes along an axis that lean by this much in all directions, with their axes in any order."""
    random = np.random.default_rng(seed)
    upright = Rotation.align_vectors(up[None], np.array([[0.0, 0.0, 1.0]]))[0]
    lean = Rotation.from_rotvec(random.normal(size=(len(turns), 3)) * np.radians(lean_deg) / np.sqrt(2))
    order = Rotation.create_group("O")[random.integers(24, size=len(turns))]
    return (lean * upright * Rotation.from_euler("z", turns[:, None]) * order).as_matrix()


@pytest.mark.parametrize("seed", range(4))
def test_the_axis_of_leaning_boxes_is_found(seed: int) -> None:
    random = np.random.default_rng(seed)
    up = random.normal(size=3)
    up /= np.linalg.norm(up)
    found = common_axis(standing(up, random.uniform(0, 2 * np.pi, 12), 6.0, seed))
    assert np.degrees(np.arccos(abs(found.axis @ up))) < 5
    assert np.degrees(found.spread_rad) < 15
    assert found.alike < 0.8


def test_boxes_that_do_not_turn_are_alike() -> None:
    turns = 0.3 + np.pi / 2 * np.arange(10)
    found = common_axis(standing(np.array([0.0, -1.0, 0.0]), turns, 1.0, 0))
    assert found.alike > 0.95


def is_rotation(matrix: np.ndarray) -> bool:
    return np.allclose(matrix.T @ matrix, np.eye(3), atol=1e-12) and np.linalg.det(matrix) > 0


@settings(deadline=None)
@given(vectors(), vectors())
def test_axes_are_right_handed_and_keep_the_major_axis(major: np.ndarray, hint: np.ndarray) -> None:
    assume(np.linalg.norm(major) > 1e-6)
    frame = right_handed_axes(major, hint)
    assert is_rotation(frame)
    np.testing.assert_allclose(frame[:, 0], unit(major), atol=1e-12)
    if np.linalg.norm(np.cross(unit(major), hint)) > 1e-6:
        assert frame[:, 1] @ hint > 0
        assert abs(frame[:, 2] @ hint) < 1e-9


def box(center, size, rotation: np.ndarray | None = None) -> OrientedBox:
    turn = np.eye(3) if rotation is None else rotation
    return OrientedBox.from_parts(np.array(center, np.float64), turn, np.array(size, np.float64))


def parts(some: list[OrientedBox]) -> list[np.ndarray]:
    return [np.array([getattr(one, name) for one in some]) for name in ("center_m", "rotation", "size_m")]


def volumes(a: list[OrientedBox], b: list[OrientedBox]) -> np.ndarray:
    return intersection_volume_pairs(*parts(a), *parts(b))


@pytest.mark.shared
@pytest.mark.parametrize("swapped", [False, True])
def test_volumes_equal_those_of_the_golden_pairs(shared: Path, swapped: bool) -> None:
    with (shared / "golden" / "iou3d_pairs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 100

    def columns(*names: str) -> np.ndarray:
        return np.array([[float(row[name]) for name in names] for row in rows])

    sides = [
        (
            columns(*(f"{side}_c{k}" for k in "xyz")),
            columns(*(f"{side}_r{i}{j}" for i in range(3) for j in range(3))).reshape(-1, 3, 3),
            columns(*(f"{side}_s{k}" for k in "xyz")),
        )
        for side in ("ba" if swapped else "ab")
    ]
    smaller = np.minimum(sides[0][2].prod(axis=1), sides[1][2].prod(axis=1))
    truth = columns("intersection")[:, 0]
    contact = truth < 1e-12 * smaller
    assert contact.sum() == 20
    found = intersection_volume_pairs(*sides[0], *sides[1])
    np.testing.assert_allclose(found[~contact], truth[~contact], rtol=1e-9)
    assert (found[contact] <= 1e-9 * smaller[contact]).all()
    made = [[OrientedBox.from_parts(*values) for values in zip(*side, strict=True)] for side in sides]
    np.testing.assert_allclose(
        [iou_3d(a, b) for a, b in zip(*made, strict=True)], columns("iou")[:, 0], rtol=1e-6, atol=1e-9
    )


@pytest.mark.parametrize("tilt_rad", [0.0, 1e-16, 1e-13, 1e-11, 1e-9, 1e-6])
def test_boxes_that_differ_by_a_tiny_rotation_lose_almost_no_volume(tilt_rad: float) -> None:
    """Where nearly coplanar faces cross depends on rounding; the loss never exceeds what the tilt can cut off."""
    count = 4000
    rng = np.random.default_rng(3)
    centers, sizes = rng.normal(size=(count, 3)), rng.uniform(0.3, 2.0, (count, 3))
    turns = Rotation.random(count, rng=rng).as_matrix()
    tilted = turns @ Rotation.from_rotvec(tilt_rad * rng.normal(size=(count, 3))).as_matrix()
    kept = intersection_volume_pairs(centers, turns, sizes, centers, tilted, sizes)
    lost = 1.0 - kept / sizes.prod(axis=1)
    assert lost.min() >= -1e-15
    assert lost.max() < 100 * tilt_rad + 1e-9


UNIT = box((0, 0, 0), (1, 1, 1))
EIGHTH = Rotation.from_rotvec([0.0, 0.0, np.pi / 4]).as_matrix()
DIAGONAL = Rotation.from_rotvec(np.arctan(np.sqrt(2.0)) * np.array([1.0, -1.0, 0.0]) / np.sqrt(2.0)).as_matrix()


@pytest.mark.parametrize(
    ("b", "expected"),
    [
        (box((2, 0, 0), (1, 1, 1)), 0.0),
        (box((1, 0, 0), (1, 1, 1)), 0.0),
        (box((0.5, 0, 0), (1, 1, 1)), 0.5),
        (box((0.25, 0.25, 0.25), (0.5, 0.5, 0.5)), 0.125),  # contained, three faces shared
        (box((0, 0, 0.5), (1, 1, 1e-6)), 0.5e-6),  # a sheet, half of it outside
        (box((0, 0, 0), (10, 10, 10), DIAGONAL), 1.0),
        (box((0, 0, 0), (1, 1, 1), EIGHTH), 2.0 * (np.sqrt(2.0) - 1.0)),  # a regular octagon
        (box((0, 0, 0), (2**0.5, 2**0.5, 1), EIGHTH), 1.0),  # all four vertical edges lie in faces
        (box((0, 0, 0), (0.5**0.5, 0.5**0.5, 1), EIGHTH), 0.5),  # all four vertical edges lie in the unit box's faces
        (box((0.5 + 0.5**0.5, 0, 0), (1, 1, 1), EIGHTH), 0.0),  # a vertical edge touches a face
        (box((0, 0, 0), (9, 9, 1e-4), DIAGONAL), 1e-4 * 0.75 * 3**0.5),  # the regular hexagon through the centre
    ],
)
def test_known_volumes_with_a_unit_box(b: OrientedBox, expected: float) -> None:
    tolerance = 1e-9 * min(1.0, b.volume_m3)
    for pair in (([UNIT], [b]), ([b], [UNIT])):
        assert volumes(*pair)[0] == pytest.approx(expected, rel=1e-6, abs=tolerance)


def test_volumes_of_turned_boxes_are_those_of_the_points_in_both() -> None:
    unit = np.random.default_rng(0).uniform(-0.5, 0.5, (100_000, 3))
    for a, b in zip(random_boxes(30, 1), random_boxes(30, 2), strict=True):
        share = contains(b, a.T_camera_box.apply(unit * a.size_m)).mean()
        assert volumes([a], [b])[0] / a.volume_m3 == pytest.approx(share, abs=0.01)


def test_a_matrix_has_the_iou_of_every_pair() -> None:
    a, b = random_boxes(12, 10, reach=1.5), random_boxes(9, 11, reach=1.5)
    matrix = iou_3d_matrix(a, b)
    np.testing.assert_allclose(matrix, [[iou_3d(one, other) for other in b] for one in a], rtol=1e-12)
    assert (matrix == 0).any()


@pytest.mark.parametrize(("which", "value"), [(0, np.nan), (1, np.inf), (2, 0.0), (2, -1.0), (2, np.nan)])
def test_invalid_boxes_are_refused(which: int, value: float) -> None:
    broken = parts([UNIT])
    broken[which] = np.full_like(broken[which], value)
    with pytest.raises(GeometryError, match="finite"):
        intersection_volume_pairs(*broken, *parts([UNIT]))


def cube(x: float) -> OrientedBox:
    return OrientedBox.from_parts(np.array([x, 0.0, 0.0]), np.eye(3), np.ones(3))


# IoU of neighbours 0.2 apart: 0.8 / 1.2 = 0.667; 0.4 apart: 0.6 / 1.4 = 0.429
ROW = [cube(0.0), cube(0.2), cube(0.4), cube(5.0)]


def test_a_dropped_box_suppresses_nothing_and_of_equal_scores_the_first_is_kept() -> None:
    assert nms_3d(ROW, np.full(4, 0.5), list("aaaa"), 0.5).tolist() == [0, 2, 3]


@settings(deadline=None)
@given(st.integers(0, 1000), st.integers(0, 25), st.floats(0.05, 0.9))
def test_a_box_is_dropped_exactly_if_a_better_kept_box_overlaps_it(seed: int, count: int, threshold: float) -> None:
    """Kept boxes do not overlap above the threshold; each dropped box overlaps a better kept box of its class."""
    rng = np.random.default_rng(seed)
    some = random_boxes(count, seed)
    scores = rng.integers(0, 5, count) / 4.0
    labels = ["ab"[k] for k in rng.integers(0, 2, count)]
    kept = nms_3d(some, scores, labels, threshold).tolist()
    iou = iou_3d_matrix(some, some)
    same = np.array([[p == q for q in labels] for p in labels]).reshape(count, count)
    ranks = [(-scores[i], i) for i in range(count)]
    assert [ranks[i] for i in kept] == sorted(ranks[i] for i in kept)
    for i in range(count):
        above = [j for j in kept if j != i and same[i, j] and iou[i, j] > threshold and ranks[j] < ranks[i]]
        assert bool(above) == (i not in kept)


@pytest.mark.parametrize(
    ("scores", "labels", "message"),
    [([0.5], ["a"] * 4, "one score"), ([0.5] * 4, ["a"], "one label"), ([np.nan, 1, 1, 1], ["a"] * 4, "finite")],
)
def test_invalid_scores_are_refused(scores: list[float], labels: list[str], message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        nms_3d(ROW, np.array(scores, np.float64), labels, 0.5)
