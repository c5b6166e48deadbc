"""Small helpers for rotations and frames; whole poses are `scipy.spatial.transform.RigidTransform`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64

from annotator.geometry.oriented_box import box_corners
from annotator.types import OrientedBox
from annotator.types.errors import GeometryError


def unit(vector: Float[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    """The direction of a vector.

    Raises:
        GeometryError: the vector is zero or not finite.
    """
    wide = np.asarray(vector, np.float64)
    length = float(np.linalg.norm(wide))
    if not (np.isfinite(length) and length > 0):
        raise GeometryError(f"{wide.tolist()} has no direction; give a finite vector that is not zero")
    return wide / length


def right_handed_frame(major: Float[np.ndarray, "3"], hint: Float[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """A right-handed orthonormal frame around one axis.

    Args:
        major: the direction that the first axis must have.
        hint: the second axis is the part of `hint` that is perpendicular to `major`. Where nothing is left of
            it, the coordinate axis that is most perpendicular to `major` takes its place.

    Returns:
        (3, 3), columns = x (along `major`), y (towards `hint`), z = x cross y; determinant +1.

    Raises:
        GeometryError: `major` has no direction, or `hint` is not finite.
    """
    x = unit(major)
    wide = np.asarray(hint, np.float64)
    if not np.isfinite(wide).all():
        raise GeometryError(f"the second axis of a frame cannot be {wide.tolist()}; give a finite vector")
    y = wide - (wide @ x) * x
    if np.linalg.norm(y) <= 1e-9 * np.linalg.norm(wide):
        y = np.eye(3)[np.argmin(np.abs(x))]
    # twice is enough (Kahan): the first pass leaves a rest where hint is nearly parallel to major
    for _ in range(2):
        y = y - (y @ x) * x
        y = y / np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def corners_4x8(box: OrientedBox) -> Float64[np.ndarray, "4 8"]:
    """The 8 corners as homogeneous columns, the form of Eq. (1) of the paper, in the camera frame and metres.

    The order is that of `oriented_box.box_corners`; a 4 x 4 transform maps them by multiplication from the left.
    """
    return np.concatenate([box_corners(box).T, np.ones((1, 8))])
