"""Intersection areas of rectangles, compared with known values and with the exact 3D IoU."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import iou_3d
from annotator.geometry.outline import rectangle_intersection_pairs
from annotator.types import OrientedBox

Rectangle = tuple[tuple[float, float], float, tuple[float, float]]


def area(a: Rectangle, b: Rectangle) -> float:
    """The intersection area of two rectangles, each given as centre, yaw (radians) and size."""
    sides = [tuple(np.array([part], np.float64) for part in rectangle) for rectangle in (a, b)]
    return float(rectangle_intersection_pairs(*sides[0], *sides[1])[0])


def upright_box(rectangle: Rectangle) -> OrientedBox:
    """The rectangle as the ground plan of a box of height 1."""
    (x, y), yaw, size = rectangle
    rotation = Rotation.from_rotvec([0.0, 0.0, yaw]).as_matrix()
    return OrientedBox.from_parts(np.array([x, y, 0.0]), rotation, np.array([*size, 1.0]))


@st.composite
def rectangles(draw: st.DrawFn) -> Rectangle:
    """On a half-metre lattice with yaws in multiples of 45 degrees, or anywhere."""
    lattice = draw(st.booleans())
    step = st.integers(-2, 2).map(lambda k: 0.5 * k) if lattice else st.floats(-1.0, 1.0)
    side = st.integers(1, 4).map(lambda k: 0.5 * k) if lattice else st.floats(0.2, 2.0)
    yaw = draw(st.integers(0, 7)) * np.pi / 4 if lattice else draw(st.floats(-4.0, 4.0))
    return draw(st.tuples(step, step)), yaw, draw(st.tuples(side, side))


@settings(deadline=None, max_examples=100)
@given(rectangles(), rectangles())
def test_areas_give_the_exact_3d_iou_of_upright_boxes(a: Rectangle, b: Rectangle) -> None:
    inner = area(a, b)
    union = np.prod(a[2]) + np.prod(b[2]) - inner
    assert inner / union == pytest.approx(iou_3d(upright_box(a), upright_box(b)), abs=1e-9)
    assert inner == pytest.approx(area(b, a), abs=1e-12)


@pytest.mark.parametrize(
    ("b", "expected"),
    [
        (((0, 0), 0.0, (1, 1)), 1.0),
        (((0, 0), np.pi / 2, (1, 1)), 1.0),
        (((0.5, 0), 0.0, (1, 1)), 0.5),
        (((1, 0), 0.0, (1, 1)), 0.0),
        (((5, 0), 0.0, (1, 1)), 0.0),
        (((0, 0), 0.0, (2, 2)), 1.0),
        (((0, 0), np.pi / 4, (2**0.5, 2**0.5)), 1.0),
        (((0, 0), np.pi / 4, (1, 1)), 2 * (2**0.5 - 1)),
    ],
)
def test_known_areas_with_a_unit_square(b: Rectangle, expected: float) -> None:
    assert area(((0.0, 0.0), 0.0, (1.0, 1.0)), b) == pytest.approx(expected, abs=1e-12)
