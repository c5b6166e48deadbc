"""Helpers for directions, rotations and poses; poses are `scipy.spatial.transform.RigidTransform`."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.geometry.oriented_box import box_corners
from annotator.types import OrientedBox
from annotator.types.errors import GeometryError, UnitError, UnitKind
from annotator.types.messages import amount

# Against gravity, for a level camera.
IMAGE_UP = np.array([0.0, -1.0, 0.0])
FORWARD = np.array([0.0, 0.0, 1.0])
# If the cosine between view direction and vertical is above this, the image's up direction counts as forward instead.
MAX_STEEPNESS = 0.99


def unit(vector: Float[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    """The unit vector in the direction of a vector; GeometryError if it is zero or not finite."""
    wide = np.asarray(vector, np.float64)
    length = float(np.linalg.norm(wide))
    if not (np.isfinite(length) and length > 0):
        raise GeometryError(f"{wide.tolist()} has no direction; give a finite, non-zero vector")
    return wide / length


def right_handed_axes(major: Float[np.ndarray, "3"], hint: Float[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Right-handed orthonormal axes: columns x (along `major`), y (towards `hint`), z = x cross y.

    y is the component of `hint` perpendicular to `major`; if they are parallel, that of the most nearly perpendicular
    coordinate axis.

    Raises:
        GeometryError: `major` has no direction, or `hint` is not finite.
    """
    x = unit(major)
    wide = np.asarray(hint, np.float64)
    if not np.isfinite(wide).all():
        raise GeometryError(f"{wide.tolist()} cannot define an axis; give a finite vector")
    y = wide - (wide @ x) * x
    if np.linalg.norm(y) <= 1e-9 * np.linalg.norm(wide):
        y = np.eye(3)[np.argmin(np.abs(x))]
    # two passes are enough (Kahan); the first one is inaccurate if `hint` is nearly parallel to `major`
    for _ in range(2):
        y = y - (y @ x) * x
        y = y / np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def corners_4x8(box: OrientedBox) -> Float64[np.ndarray, "4 8"]:
    """The 8 corners of a box as homogeneous columns, as in Eq. (1) of the paper; camera frame, metres.

    The order is that of `oriented_box.box_corners`. A 4 x 4 transform is applied by multiplication from the left.
    """
    return np.concatenate([box_corners(box).T, np.ones((1, 8))])


def level_pose(up: Float[np.ndarray, "3"] | None) -> RigidTransform:
    """T_level_camera of the level axes at the camera: x horizontally forward, y left, z against gravity.

    `up` is a unit vector against gravity in the camera frame; None assumes a level camera.
    """
    against = IMAGE_UP if up is None else up
    ahead = FORWARD if abs(float(against @ FORWARD)) < MAX_STEEPNESS else IMAGE_UP
    z, x, y = right_handed_axes(against, ahead).T
    return RigidTransform.from_rotation(Rotation.from_matrix(np.stack([x, y, z])))


# Whether a set of quaternions is in the order that its format has: w first, or w last.
#
# What stands upright, such as boxes and vehicles, does so in one order only, unless it is turned by half a circle or
# not at all. One quaternion seldom shows the order, but all of a set together do.


# What is upright in a level frame; least cosine of its tilt: slopes, and drives over bumps.
UPRIGHT = math.cos(math.radians(10))
# Share of the set that is upright if the quaternions are read in the other order.
NEARLY_ALL = 0.95


class Quaternions:
    """The quaternions of a set of things that stand upright in their frame, as they are in the file.

    `w_first`: the format's order is w x y z; False: x y z w. `thing` and `things` are words with the verb.
    """

    def __init__(self, *, w_first: bool = True, thing: str = "box is", things: str = "boxes are") -> None:
        self._w_first, self._thing, self._things = w_first, thing, things
        self._values = array("d")

    def add(self, quaternion: Iterable[float]) -> None:
        self._values.extend(quaternion)

    def problem(self) -> str | None:
        """Returns what shows that the quaternions are in the other order; None if nothing does."""
        values = np.array(self._values).reshape(-1, 4)
        if len(values) == 0:
            return None
        first, last = _upright(values, w_first=True), _upright(values, w_first=False)
        own, other = (first, last) if self._w_first else (last, first)
        if other.mean() < NEARLY_ALL or other.sum() <= own.sum():
            return None
        orders = ("w x y z", "x y z w") if self._w_first else ("x y z w", "w x y z")
        tilted = len(own) - int(own.sum())
        return (
            f"the quaternions are in the order {orders[1]}, and this format has {orders[0]}: as {orders[0]}, "
            f"{tilted} of {amount(len(own), self._thing, self._things)} tilted, and as {orders[1]} "
            f"{len(own) - int(other.sum())}; write them as {orders[0]}"
        )

    def require(self, path: Path) -> None:
        """Raises UnitError if the quaternions are in the other order."""
        if (problem := self.problem()) is not None:
            raise UnitError(UnitKind.QUATERNION, path, problem)


def _upright(values: Float64[np.ndarray, "n 4"], *, w_first: bool) -> np.ndarray:
    """Returns which quaternions leave the z axis upright: R[2, 2] = 1 - 2 (x^2 + y^2) of a unit quaternion."""
    x, y = (values[:, 1], values[:, 2]) if w_first else (values[:, 0], values[:, 1])
    squares = (values**2).sum(axis=1)
    return 1 - 2 * (x**2 + y**2) / np.where(squares > 0, squares, 1) > UPRIGHT
