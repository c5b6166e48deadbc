"""The level frame at a camera's place, for formats that want z upwards."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.geometry.transforms import right_handed_frame

# Against gravity, for a camera that is held level.
IMAGE_UP = np.array([0.0, -1.0, 0.0])
FORWARD = np.array([0.0, 0.0, 1.0])
# A camera that looks up or down more steeply has no horizontal direction ahead; the image's upper edge takes its place.
MOST_STEEP = 0.99


def level_pose(up: Float[np.ndarray, "3"] | None) -> RigidTransform:
    """T_level_camera: x horizontally ahead, y left, z against gravity; the origin is the camera's.

    Args:
        up: unit vector against gravity in the camera frame; None: the camera is taken to be held level.
    """
    against = IMAGE_UP if up is None else up
    ahead = FORWARD if abs(float(against @ FORWARD)) < MOST_STEEP else IMAGE_UP
    z, x, y = right_handed_frame(against, ahead).T
    return RigidTransform.from_rotation(Rotation.from_matrix(np.stack([x, y, z])))
