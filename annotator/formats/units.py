"""Whether the numbers of a set of boxes are in the unit that their format has.

Programs write degrees where a format has radians, millimetres where it has metres. One box seldom shows that, but all
boxes of a set together do. So a reader hands over the numbers of all boxes that belong together, and a set that cannot
be right is refused. What can be right is read: a format's unit is doubted only where its numbers contradict it.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from annotator.types.errors import UnitError, UnitKind
from annotator.types.messages import amount

# Programs write angles in radians that they have not normalised: OpenPCDet's KITTI results have rotation_y down to
# -2.75 pi. Those of a set in degrees nearly always have a larger one. Files round to two decimals.
MOST_RAD = 3 * math.pi + 0.01
BEYOND = "beyond 3 pi"
# Limits of the median of the boxes' longest sides, metres. Few objects of a scene are longer than the first one, as
# ships are; none is longer than the second one, or shorter than the third.
LONG_M, LONGEST_M, SHORTEST_M = 100.0, 1000.0, 0.005


class AngleUnit(StrEnum):
    """Units of angles."""

    RADIANS = "radians"
    DEGREES = "degrees"


class Angles:
    """The angles of a set of boxes in a format that has radians; each passes through `radians` while it is read.

    Args:
        given: the unit that the operator has stated; then nothing is doubted.
    """

    def __init__(self, given: AngleUnit | None = None) -> None:
        self._given = given
        self._count = self._beyond = 0
        self._worst: tuple[float, Path, int | None] | None = None

    def radians(self, value: float, file: Path, line: int | None = None) -> float:
        """Returns an angle of a file in radians."""
        if self._given is AngleUnit.DEGREES:
            return math.radians(value)
        self._count += value != 0
        if abs(value) > MOST_RAD:
            self._beyond += 1
            if self._worst is None or abs(value) > abs(self._worst[0]):
                self._worst = (value, file, line)
        return value

    def require(self) -> None:
        """Raises UnitError if something shows that they are not in radians; it names the place of the largest one."""
        if self._worst is None or self._given is not None:
            return
        value, file, line = self._worst
        problem = (
            f"{value:g} is no angle in radians, which this format has ({self._beyond} of "
            f"{amount(self._count, 'angle')} other than 0 {BEYOND}); write radians (`annotator import` converts "
            f"degrees with --angles {AngleUnit.DEGREES}, and reads the angles as they are with --angles "
            f"{AngleUnit.RADIANS})"
        )
        raise UnitError(UnitKind.ANGLE, file, problem, line)


class Lengths:
    """The sizes of a set of boxes, in a format that has metres."""

    def __init__(self, sizes_m: Iterable[Float64[np.ndarray, "3"]] = ()) -> None:
        self._longest = array("d", (float(max(size_m)) for size_m in sizes_m))

    def add(self, size_m: Float64[np.ndarray, "3"]) -> None:
        """Adds the size of a box."""
        self._longest.append(float(max(size_m)))

    def problem(self) -> str | None:
        """Returns what shows that the sizes are hardly in metres; None if nothing does."""
        longest, median = np.array(self._longest), self._median_m
        if SHORTEST_M <= median <= LONG_M:
            return None
        off = (longest > LONG_M) if median > LONG_M else (longest < SHORTEST_M)
        boxes = f"{off.sum()} of {amount(len(longest), 'box')} {'is' if off.sum() == 1 else 'are'}"
        if median > LONG_M:
            unit = "millimetres" if median > LONGEST_M else "millimetres or centimetres"
            what = f"longer than {LONG_M:g} m (the median is {median:g} m), so they look like {unit}"
        else:
            what = f"shorter than {1000 * SHORTEST_M:g} mm (the median is {median:g} m), so they look like kilometres"
        return f"{boxes} {what}; write centres and sizes in metres"

    @property
    def _median_m(self) -> float:
        return float(np.median(self._longest)) if self._longest else 1.0

    def require(self, path: Path) -> None:
        """Raises UnitError if the sizes cannot be in metres."""
        if not SHORTEST_M <= self._median_m <= LONGEST_M and (problem := self.problem()) is not None:
            raise UnitError(UnitKind.LENGTH, path, problem)


# Tolerance for R^T R = identity, since matrices in files are rounded.
MOST_OFF_ROTATION = 1e-2


def rotation_problem(R: Float64[np.ndarray, "3 3"], most_off: float = MOST_OFF_ROTATION) -> str | None:
    """Returns why a matrix of a file is no rotation; None if it is one."""
    if not np.abs(R.T @ R - np.eye(3)).max() <= most_off:
        return "is not a rotation (its columns must have length 1 and be at right angles)"
    if np.linalg.det(R) < 0:
        return "has left-handed axes (it mirrors: its determinant is -1), and annotator's are right-handed; negate one"
    return None


def angles_xyz(R: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3"]:
    """Returns the angles x, y, z of R = Rx Ry Rz, radians in [-pi, pi].

    If the z axis that it turns lies along x (gimbal lock), only the sum or difference of x and z is determined. y and z
    are computed from the rotation that remains after x, so that all three together are exact.
    """
    x = np.arctan2(-R[1, 2], R[2, 2])
    rest = Rotation.from_rotvec([-x, 0.0, 0.0]).as_matrix() @ R
    return np.array([x, np.arctan2(rest[0, 2], rest[2, 2]), np.arctan2(rest[1, 0], rest[1, 1])])
