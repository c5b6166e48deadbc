"""`calib/ID.txt`: the transform from a cloud's frame to the camera, in KITTI's form, as labelCloud stores it.

`px = P2 * R0_rect * Tr_velo_to_cam * X`, matrices row by row (KITTI object devkit, readme.txt). P2 may shift rectified
camera 0 to the colour camera: P2 = K [I | t].
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.json_file import MOST
from annotator.formats.text_folder import text_rows
from annotator.formats.units import rotation_problem
from annotator.text import to_number
from annotator.types import Camera
from annotator.types.errors import FormatError

SHAPES = {"P2": (3, 4), "R0_rect": (3, 3), "Tr_velo_to_cam": (3, 4)}
# Tolerance for R^T R = identity; matrices in files are rounded.
MOST_OFF_ROTATION = 1e-2


def dump_calibration(camera: Camera, T_camera_cloud: RigidTransform) -> str:
    """Returns the text for an ideal camera, unrounded; P0 to P3 are that camera, the IMU's matrix is the identity."""
    P = np.hstack([camera.matrix, np.zeros((3, 1))])
    matrices = {f"P{number}": P for number in range(4)} | {
        "R0_rect": np.eye(3),
        "Tr_velo_to_cam": T_camera_cloud.as_matrix()[:3],
        "Tr_imu_to_velo": np.eye(3, 4),
    }
    return "".join(
        f"{name}: {' '.join(repr(value + 0.0) for value in matrix.ravel().tolist())}\n"
        for name, matrix in matrices.items()
    )


def read_calibration_pose(path: Path) -> RigidTransform:
    """Returns T_camera_cloud of a file.

    Raises:
        FormatError: the file cannot be read, or a matrix is missing, has the wrong number of values or is invalid.
    """
    matrices: dict[str, Float64[np.ndarray, "r c"]] = {}
    for line, (head, *words) in text_rows(path):
        name = head.rstrip(":")
        shape = SHAPES.get(name)
        if shape is None:
            continue
        try:
            matrix = np.array([to_number(word) for word in words]).reshape(shape)
        except ValueError as error:
            raise FormatError(path, f"{name} needs {shape[0] * shape[1]} numbers: {error}", line) from error
        if not (np.abs(matrix) <= MOST).all():
            raise FormatError(path, f"{name} must be finite and at most {MOST:g}", line)
        matrices[name] = matrix
    if missing := [name for name in SHAPES if name not in matrices]:
        raise FormatError(path, f"has no {' and no '.join(missing)}")
    P2, pose = matrices["P2"], matrices["R0_rect"] @ matrices["Tr_velo_to_cam"]
    R = pose[:, :3]
    if (problem := rotation_problem(R, MOST_OFF_ROTATION)) is not None:
        raise FormatError(path, f"R0_rect * Tr_velo_to_cam {problem}")
    try:
        shift = np.linalg.solve(P2[:, :3], P2[:, 3])
    except np.linalg.LinAlgError as error:
        raise FormatError(path, "P2 is not a camera matrix: its left 3x3 part is singular") from error
    return RigidTransform.from_components(pose[:, 3] + shift, Rotation.from_matrix(R))
