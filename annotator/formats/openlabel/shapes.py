"""Converts cuboids, transforms and cameras to and from OpenLABEL's numbers.

Source: ASAM OpenLABEL 1.0.0, JSON schema (`cuboid`, `transform_data`, `stream_properties`). The schema does not define
the order of a cuboid's Euler angles; it is taken from Vicomtech's VCD library, the standard's reference implementation:
`rx ry rz` mean R = Rz(rz) Ry(ry) Rx(rx), and `sequence` names intrinsic rotations, "ZYX" by default.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.openlabel.model import Pinhole, TransformData
from annotator.formats.units import rotation_problem
from annotator.types import Camera, OrientedBox

# Largest deviation of a 4x4 matrix from a rigid motion; files hold rounded numbers.
RIGID = 1e-3


def cuboid_values(box: OrientedBox) -> tuple[float, ...]:
    """Returns x y z qx qy qz qw sx sy sz of a box, in the box's frame of reference; metres, qw not negative."""
    quaternion = box.T_camera_box.rotation.as_quat(canonical=True)
    return tuple(np.concatenate([box.center_m, quaternion, box.size_m]).tolist())


def box_from(values: tuple[float, ...], *, degrees: bool = False) -> OrientedBox:
    """Returns the box of 10 values (quaternion x y z w) or 9 (Euler angles rx ry rz, radians).

    Args:
        degrees: the angles are in degrees.

    Raises:
        ValueError: neither 9 nor 10 values, a quaternion that is not of unit length, or a size that is not positive.
    """
    if len(values) == 10:
        rotation = _rotation(values[3:7])
    elif len(values) == 9:
        rotation = Rotation.from_euler("ZYX", values[5:2:-1], degrees=degrees)
    else:
        raise ValueError(f"a cuboid has 9 or 10 values, not {len(values)}")
    return OrientedBox.at(RigidTransform.from_components(np.array(values[:3]), rotation), np.array(values[-3:]))


def _rotation(xyzw: tuple[float, ...]) -> Rotation:
    if not 0.5 < np.linalg.norm(xyzw) < 2.0:
        raise ValueError(f"{list(xyzw)} is not a unit quaternion")
    return Rotation.from_quat(np.array(xyzw))


def transform_values(T_dst_src: RigidTransform) -> TransformData:
    """Returns the transform as quaternion and translation."""
    x, y, z = T_dst_src.translation.tolist()
    qx, qy, qz, qw = T_dst_src.rotation.as_quat(canonical=True).tolist()
    return TransformData(quaternion=(qx, qy, qz, qw), translation=(x, y, z))


def transform_from(data: TransformData) -> RigidTransform:
    """Returns the transform from any of the three forms.

    Raises:
        ValueError: none of the forms is complete, or the matrix is not a rigid motion.
    """
    if data.matrix4x4 is not None:
        matrix = np.array(data.matrix4x4).reshape(4, 4)
        R = matrix[:3, :3]
        if not np.abs(matrix[3] - (0, 0, 0, 1)).max() <= RIGID:
            raise ValueError("matrix4x4 is not a rigid motion (rotation and translation, row by row)")
        if (problem := rotation_problem(R, RIGID)) is not None:
            raise ValueError(f"matrix4x4 is not a rigid motion: its rotation {problem}")
        return RigidTransform.from_components(matrix[:3, 3], Rotation.from_matrix(R))
    if data.translation is None:
        raise ValueError("a transform needs matrix4x4, or translation with quaternion or euler_angles")
    if data.quaternion is not None:
        rotation = _rotation(data.quaternion)
    elif data.euler_angles is not None:
        rotation = _euler(data.euler_angles, (data.sequence or "ZYX").upper())
    else:
        raise ValueError("a transform with a translation also needs quaternion or euler_angles")
    return RigidTransform.from_components(np.array(data.translation), rotation)


def _euler(angles_rad: tuple[float, float, float], sequence: str) -> Rotation:
    """Returns intrinsic rotations about the named axes."""
    if any(a == b for a, b in pairwise(sequence)):
        raise ValueError(f"the sequence {sequence} names one axis twice in a row")
    return Rotation.from_euler(sequence, angles_rad)


def pinhole_of(camera: Camera) -> Pinhole:
    """Returns the camera's record: K as 3x4, OpenCV's coefficients padded with zeros to the 5 that the schema needs."""
    coefficients = camera.distortion + (0.0,) * (5 - len(camera.distortion))
    return Pinhole(
        width_px=camera.width_px,
        height_px=camera.height_px,
        camera_matrix=tuple(np.hstack([camera.matrix, np.zeros((3, 1))]).ravel().tolist()),
        distortion_coeffs=coefficients,
    )
