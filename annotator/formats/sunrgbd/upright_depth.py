"""The frame "upright depth" of SUN RGB-D's labels, for any frame: x right, y forward, z up, origin at the camera.

Recordings of SUN RGB-D have their own transform. For others it follows from gravity: y is the levelled viewing
direction. A camera's point is mapped by `Rtilt * [X, Z, -Y]` (SUNRGBDtoolbox, `read3dPoints.m`).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.geometry.transforms import level_pose
from annotator.types import Camera, Frame

# [X, Z, -Y] of a camera's point [X, Y, Z].
SWAPPED = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
# The level frame at the camera has x ahead and y to the left.
LEVEL_UPRIGHT = RigidTransform.from_rotation(
    Rotation.from_matrix(np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
)
# SUN RGB-D counts pixels from 1.
FIRST_PX = 1.0
# Tolerance for an up axis equal to gravity, and for a zero translation.
SAME = 1e-6


def upright_frame(frame: Frame) -> RigidTransform:
    """Returns T_camera_upright of a frame; if gravity is unknown, it is assumed to point down the image."""
    up, T = frame.up, frame.T_camera_label
    if T is not None and up is not None and np.linalg.norm(T.translation) < SAME:
        label_up = T.rotation.apply([0.0, 0.0, 1.0])
        if np.linalg.norm(label_up - up) < SAME:
            return T
    return level_pose(up).inv() * LEVEL_UPRIGHT


def tilt_matrix(T_camera_upright: RigidTransform) -> Float64[np.ndarray, "3 3"]:
    """Returns `Rtilt` of a frame."""
    return np.asarray(T_camera_upright.inv().rotation.as_matrix() @ SWAPPED.T)


def one_based_matrix(camera: Camera) -> Float64[np.ndarray, "3 3"]:
    """Returns `K` of a camera, pixels counted from 1."""
    return camera.matrix + np.array([[0.0, 0.0, FIRST_PX], [0.0, 0.0, FIRST_PX], [0.0, 0.0, 0.0]])
