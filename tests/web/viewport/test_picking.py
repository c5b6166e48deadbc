"""Picking of boxes by rays."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from annotator.types import OrientedBox
from annotator.web.viewport.drawing import pick

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
    assert pick([], ORIGIN, AHEAD) is None


def test_boxes_around_the_ray_s_origin_come_last() -> None:
    assert pick([box_at(0, 20), box_at(3)], ORIGIN, AHEAD) == 1
    assert pick([box_at(0, 20), box_at(0, 2)], ORIGIN, AHEAD) == 1
    assert pick([box_at(0, 20)], ORIGIN, AHEAD) == 0


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
