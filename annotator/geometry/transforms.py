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


def nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    """The proper rotation (determinant +1) nearest to a matrix in the Frobenius norm (orthogonal Procrustes).

    Raises:
        GeometryError: the matrix is not finite.
    """
    wide = np.asarray(matrix, np.float64)
    if not np.isfinite(wide).all():
        raise GeometryError("no rotation is near a matrix with values that are not finite")
    left, _, right = np.linalg.svd(wide)
    left[:, 2] *= np.sign(np.linalg.det(left @ right))
    return left @ right


def rotation_between_axes(source: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """The smallest rotation R that turns one direction onto another: `R @ source` is parallel to `target`.

    For opposite directions the half turn is about an arbitrary, but always the same, perpendicular axis.

    Raises:
        GeometryError: one of the vectors has no direction.
    """
    a, b = unit(source), unit(target)
    if a @ b < -0.5:
        # First a half turn about the same axis: Rodrigues' formula below divides by 0 at opposite directions.
        axis = right_handed_frame(a, b)[:, 2]
        half_turn = 2.0 * np.outer(axis, axis) - np.eye(3)
        return rotation_between_axes(-a, b) @ half_turn
    cross = np.cross(a, b)
    skew = np.array([[0.0, -cross[2], cross[1]], [cross[2], 0.0, -cross[0]], [-cross[1], cross[0], 0.0]])
    return np.eye(3) + skew + skew @ skew / (1.0 + a @ b)


def rotation_angle_rad(rotation_a: Float[np.ndarray, "3 3"], rotation_b: Float[np.ndarray, "3 3"]) -> float:
    """The angle in 0..pi of the rotation that leads from one rotation matrix to another."""
    relative = np.asarray(rotation_a, np.float64).T @ np.asarray(rotation_b, np.float64)
    axial = np.array(
        [relative[2, 1] - relative[1, 2], relative[0, 2] - relative[2, 0], relative[1, 0] - relative[0, 1]]
    )
    # atan2 keeps its precision near 0 and pi, where the arc cosine of the trace loses half of the digits
    return float(np.arctan2(np.linalg.norm(axial), np.trace(relative) - 1.0))


def corners_4x8(box: OrientedBox) -> Float64[np.ndarray, "4 8"]:
    """The 8 corners as homogeneous columns, the form of Eq. (1) of the paper, in the camera frame and metres.

    The order is that of `oriented_box.box_corners`; a 4 x 4 transform maps them by multiplication from the left.
    """
    return np.concatenate([box_corners(box).T, np.ones((1, 8))])
