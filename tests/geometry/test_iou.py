"""Exact 3D IoU: properties, closed formulas, an independent computation, and pairs with known volumes."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from geometry_strategies import random_boxes
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import (
    intersection_volume_pairs,
    iou_3d,
    iou_3d_matrix,
    nms_3d,
)
from annotator.geometry.oriented_box import contains
from annotator.types import OrientedBox
from annotator.types.errors import GeometryError


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
