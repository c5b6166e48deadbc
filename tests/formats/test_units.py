"""Numbers in another unit or order than their format has are recognised; right ones never are."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.formats.units import Angles, AngleUnit, Lengths, rotation_problem
from annotator.geometry.transforms import Quaternions
from annotator.types.errors import UnitError, UnitKind

FILE = Path("a.txt")
TURN = 2 * math.pi


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ([], None),
        ([0.0, 0.0], None),
        ([3.14, -3.14, 1.5], None),
        ([TURN, -6.28, 6.29], None),
        # OpenPCDet: rotation_y = -heading - pi/2, heading in pi/4 .. 9/4 pi
        ([-8.64, -2.36, -5.0], None),
        ([9.43, -9.43], None),
        ([-90.0], r"-90 is no angle in radians.* \(1 of 1 angle other"),
        ([0.0, 2.0, 180.0, -270.0], r"-270 is no angle in radians.* \(2 of 3 angles other"),
        ([9.45, 1.0], r"9.45 is no angle in radians.* \(1 of 2 angles"),
    ],
)
def test_angles_beyond_one_and_a_half_turns_are_no_radians(values: list[float], said: str | None) -> None:
    angles = Angles()
    assert [angles.radians(value, FILE, line) for line, value in enumerate(values, 1)] == values
    if said is None:
        angles.require()
    else:
        with pytest.raises(UnitError, match=said) as caught:
            angles.require()
        worst = max(range(len(values)), key=lambda place: abs(values[place]))
        assert (caught.value.kind, caught.value.path, caught.value.line) == (UnitKind.ANGLE, FILE, worst + 1)
        assert "--angles degrees" in str(caught.value) and "--angles radians" in str(caught.value)


def test_the_unit_that_the_operator_states_is_not_doubted() -> None:
    degrees, radians = Angles(AngleUnit.DEGREES), Angles(AngleUnit.RADIANS)
    assert degrees.radians(-90.0, FILE) == pytest.approx(-math.pi / 2)
    assert radians.radians(-90.0, FILE) == -90
    degrees.require()
    radians.require()


@pytest.mark.parametrize(
    ("sizes", "said"),
    [
        ([], None),
        ([(4, 2, 1.6), (0.2, 0.1, 0.1), (90, 3, 3)], None),
        ([(0.19, 0.08, 0.03)], None),
        ([(4, 2, 1.6), (4000, 2000, 1600), (5, 2, 2)], None),
        ([(4000, 2000, 1600)], r"1 of 1 box is longer than 100 m \(the median is 4000 m\).* millimetres;"),
        ([(0.004, 0.002, 0.0016)] * 2, r"2 of 2 boxes are shorter than 5 mm .* kilometres"),
    ],
)
def test_sizes_of_most_boxes_that_no_scene_has_are_no_metres(
    sizes: list[tuple[float, float, float]], said: str | None
) -> None:
    lengths = Lengths(np.array(size, float) for size in sizes)
    if said is None:
        lengths.require(FILE)
    else:
        with pytest.raises(UnitError, match=said) as caught:
            lengths.require(FILE)
        assert caught.value.kind is UnitKind.LENGTH


def test_sizes_of_ships_are_doubted_and_read() -> None:
    lengths = Lengths(np.array(size, float) for size in [(400, 200, 160), (420, 180, 150), (4, 2, 2)])
    lengths.require(FILE)
    assert (lengths.problem() or "").startswith(
        "2 of 3 boxes are longer than 100 m (the median is 400 m), so they look"
    )


def yaws(*degrees: float, w_first: bool) -> list[list[float]]:
    rotations = [Rotation.from_rotvec([0, 0, each], degrees=True) for each in degrees]
    return [each.as_quat(scalar_first=w_first).tolist() for each in rotations]


TILTED = Rotation.random(6, rng=np.random.default_rng(0)).as_quat(scalar_first=True).tolist()


@pytest.mark.parametrize(
    ("w_first", "values", "tilted"),
    [
        (True, yaws(30, w_first=False), 1),
        (True, yaws(0, 3, -90, 180, 5, w_first=False), 2),
        (False, yaws(30, 150, w_first=True), 2),
        # upright as they are
        (True, yaws(0, 30, 90, -90, 180, w_first=True), 0),
        (False, yaws(0, 30, 90, -90, 180, w_first=False), 0),
        # a heading of 180 degrees is upright in both orders
        (True, [[0.0, 0.0, 0.0, 1.0]], 0),
        # tilted in both orders
        (True, TILTED, 0),
        (True, [], 0),
        (True, [[0.0, 0.0, 0.0, 0.0]], 0),
    ],
)
def test_upright_boxes_show_the_order_of_their_quaternions(
    w_first: bool, values: list[list[float]], tilted: int
) -> None:
    quaternions = Quaternions(w_first=w_first)
    for each in values:
        quaternions.add(each)
    if tilted == 0:
        quaternions.require(FILE)
    else:
        boxes = "box is" if len(values) == 1 else "boxes are"
        with pytest.raises(UnitError, match=f"{tilted} of {len(values)} {boxes} tilted, .* 0; write") as caught:
            quaternions.require(FILE)
        assert caught.value.kind is UnitKind.QUATERNION


def test_a_mirrored_matrix_is_called_left_handed() -> None:
    turn = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix()
    assert rotation_problem(turn, 1e-3) is None
    assert "left-handed" in (rotation_problem(turn * [1, -1, 1], 1e-3) or "")
    for wrong in (2 * turn, np.full((3, 3), np.nan)):
        assert "is not a rotation" in (rotation_problem(wrong, 1e-3) or "")
