"""Helpers for directions, rotations and poses; poses are `scipy.spatial.transform.RigidTransform`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.geometry.oriented_box import box_corners
from annotator.types import OrientedBox
from annotator.types.errors import GeometryError

# Against gravity, for a level camera.
IMAGE_UP = np.array([0.0, -1.0, 0.0])
FORWARD = np.array([0.0, 0.0, 1.0])
# If the cosine between view direction and vertical is above this, the image's up direction counts as forward instead.
MAX_STEEPNESS = 0.99


def unit(vector: Float[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    """The unit vector in the direction of a vector.

    Raises:
        GeometryError: the vector is zero or not finite.
    """
    wide = np.asarray(vector, np.float64)
    length = float(np.linalg.norm(wide))
    if not (np.isfinite(length) and length > 0):
        raise GeometryError(f"{wide.tolist()} has no direction; give a finite, non-zero vector")
    return wide / length


def right_handed_axes(major: Float[np.ndarray, "3"], hint: Float[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Right-handed orthonormal axes with a given first axis.

    Args:
        major: direction of the first axis.
        hint: the second axis is the component of `hint` perpendicular to `major`. If `hint` is parallel to `major`,
            the most nearly perpendicular coordinate axis is used instead.

    Returns:
        (3, 3), columns = x (along `major`), y (towards `hint`), z = x cross y; determinant +1.

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

    Args:
        up: unit vector against gravity in the camera frame; None assumes a level camera.
    """
    against = IMAGE_UP if up is None else up
    ahead = FORWARD if abs(float(against @ FORWARD)) < MAX_STEEPNESS else IMAGE_UP
    z, x, y = right_handed_axes(against, ahead).T
    return RigidTransform.from_rotation(Rotation.from_matrix(np.stack([x, y, z])))
