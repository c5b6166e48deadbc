"""Upright and bird's-eye IoU, against the exact 3D one."""

from __future__ import annotations

import numpy as np
import pytest
from geometry_strategies import vectors
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import (
    iou_3d,
    iou_3d_matrix,
    iou_bev,
    iou_bev_matrix,
    iou_upright,
    iou_upright_matrix,
)
from annotator.geometry.transforms import right_handed_frame
from annotator.types import OrientedBox
from annotator.types.errors import GeometryError

Z = np.array([0.0, 0.0, 1.0])


def upright_box(center, size, yaw_rad: float = 0.0, up: np.ndarray = Z, head_down: bool = False) -> OrientedBox:
    """Centre in a frame whose third axis is up."""
    ground = right_handed_frame(up, np.array([1.0, 0.0, 0.0]))[:, [1, 2, 0]]
    turn = ground @ Rotation.from_rotvec([0.0, 0.0, yaw_rad]).as_matrix()
    if head_down:
        turn = turn @ np.diag([1.0, -1.0, -1.0])
    return OrientedBox.from_parts(ground @ np.array(center, np.float64), turn, np.array(size, np.float64))


@st.composite
def upright_boxes(draw: st.DrawFn, up: np.ndarray) -> OrientedBox:
    """On a half-metre lattice with many quarter and eighth turns, or anywhere."""
    lattice = draw(st.booleans())
    step = st.integers(-2, 2).map(lambda k: 0.5 * k) if lattice else st.floats(-1.0, 1.0)
    side = st.integers(1, 4).map(lambda k: 0.5 * k) if lattice else st.floats(0.2, 2.0)
    yaw = draw(st.integers(0, 7)) * np.pi / 4 if lattice else draw(st.floats(-4.0, 4.0))
    return upright_box(
        draw(st.tuples(step, step, step)), draw(st.tuples(side, side, side)), yaw, up, draw(st.booleans())
    )


@settings(deadline=None, max_examples=100)
@given(st.data(), vectors())
def test_upright_iou_is_the_exact_3d_iou(data: st.DataObject, up: np.ndarray) -> None:
    assume(np.linalg.norm(up) > 0.1)
    a, b = data.draw(upright_boxes(up)), data.draw(upright_boxes(up))
    assert iou_upright(a, b, up) == pytest.approx(iou_3d(a, b), abs=1e-9)
    assert iou_upright(a, b, -up) == pytest.approx(iou_upright(b, a, up), abs=1e-12)


@settings(deadline=None, max_examples=100)
@given(st.data())
def test_birds_eye_iou_is_the_upright_iou_of_boxes_of_one_height(data: st.DataObject) -> None:
    a, b = (data.draw(upright_boxes(Z)) for _ in range(2))
    flat_a, flat_b = (
        OrientedBox.from_parts(one.center_m * [1, 1, 0], one.rotation, one.size_m * [1, 1, 0] + Z) for one in (a, b)
    )
    assert iou_bev(a, b, Z) == pytest.approx(iou_3d(flat_a, flat_b), abs=1e-9)
    assert iou_bev(a, b, Z) == pytest.approx(iou_upright(flat_a, flat_b, Z), abs=1e-12)


@pytest.mark.parametrize(
    ("b", "bev", "upright"),
    [
        (upright_box((0, 0, 0), (1, 1, 1)), 1.0, 1.0),
        (upright_box((0, 0, 0), (1, 1, 1), np.pi / 2), 1.0, 1.0),
        (upright_box((0, 0, 0), (1, 1, 1), 0.0, head_down=True), 1.0, 1.0),
        (upright_box((0.5, 0, 0), (1, 1, 1)), 1 / 3, 1 / 3),
        (upright_box((0, 0, 0.5), (1, 1, 1)), 1.0, 1 / 3),
        (upright_box((0, 0, 1), (1, 1, 1)), 1.0, 0.0),
        (upright_box((1, 0, 0), (1, 1, 1)), 0.0, 0.0),
        (upright_box((5, 0, 0), (1, 1, 1)), 0.0, 0.0),
        (upright_box((0, 0, 0), (2, 2, 1)), 0.25, 0.25),
        (upright_box((0, 0, 0), (2**0.5, 2**0.5, 1), np.pi / 4), 0.5, 0.5),
        (upright_box((0, 0, 0), (1, 1, 1), np.pi / 4), 1 / 2**0.5, 1 / 2**0.5),
    ],
)
def test_known_overlaps_with_a_unit_box(b: OrientedBox, bev: float, upright: float) -> None:
    a = upright_box((0, 0, 0), (1, 1, 1))
    assert iou_bev(a, b, Z) == pytest.approx(bev, abs=1e-12)
    assert iou_upright(a, b, Z) == pytest.approx(upright, abs=1e-12)


def test_matrices_agree_with_the_exact_matrix() -> None:
    rng = np.random.default_rng(0)
    up = np.array([0.1, -1.0, 0.05])
    some = [upright_box(rng.normal(size=3), rng.uniform(0.3, 2, 3), rng.uniform(0, 7), up) for _ in range(25)]
    exact = iou_3d_matrix(some, some[:10])
    np.testing.assert_allclose(iou_upright_matrix(some, some[:10], up), exact, atol=1e-9)
    assert (iou_bev_matrix(some, some[:10], up) >= exact - 1e-9).all()
    assert iou_upright_matrix([], some, up).shape == (0, 25)


def test_a_box_that_leans_is_refused_with_its_number_and_angle() -> None:
    upright = upright_box((0, 0, 0), (1, 1, 1))
    leaning = OrientedBox.from_parts(np.zeros(3), Rotation.from_rotvec([0.002, 0, 0]).as_matrix(), np.ones(3))
    slightly = OrientedBox.from_parts(np.zeros(3), Rotation.from_rotvec([0.0009, 0, 0]).as_matrix(), np.ones(3))
    assert iou_upright(upright, slightly, Z) == pytest.approx(1.0, abs=1e-6)
    with pytest.raises(GeometryError, match=r"box 1 leans by 0\.0020 rad"):
        iou_upright_matrix([upright, leaning], [upright], Z)
    with pytest.raises(GeometryError, match="leans"):
        iou_bev(upright, leaning, Z)
