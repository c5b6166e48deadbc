"""What ARKit gives to recordings: depth and its confidence beside the image, and which way is up.

Apple's depth image shows the same part of the scene as the colour image, with fewer pixels. Confidence is 0 (low), 1 or
2 (high). ARKit's world has y up (`ARConfiguration.WorldAlignment.gravity`).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.geometry.projection import resized
from annotator.recordings.two_cameras import registered
from annotator.types import Camera, PointCloud
from annotator.types.errors import FrameError

# The lowest confidence that is used, unless the option `min_confidence` says otherwise. Low confidence is found at
# edges, where values lie between object and background, and on dark or shiny surfaces.
MIN_CONFIDENCE = 1
UP = np.array([0.0, 1.0, 0.0])
MOST_OFF_UNIT = 1e-3
# Part of the up direction that must lie in the image plane to tell which way an image is held.
LEAST_UPRIGHT = 0.3


def phone_cloud(
    path: Path,
    camera: Camera,
    rgb: UInt8[np.ndarray, "H W 3"],
    depth_m: Float32[np.ndarray, "h w"],
    confidence: UInt8[np.ndarray, "h w"] | None,
    min_confidence: int | None,
) -> tuple[PointCloud, Float32[np.ndarray, "H W"]]:
    """Returns the coloured points of a phone's depth image, and the depth in the colour image's pixels.

    Args:
        path: of the depth image, for messages.
        camera: the colour camera.
        depth_m: z, metres; zero, negative, NaN and infinite values mean no measurement.
        confidence: of each depth pixel; None if it was not recorded.
        min_confidence: pixels with less are left out; None for the default.
    """
    least = MIN_CONFIDENCE if min_confidence is None else min_confidence
    if confidence is not None:
        depth_m = np.where(confidence >= least, depth_m, np.float32(0))
    depth_camera = resized(camera, depth_m.shape[1], depth_m.shape[0])
    cloud, in_color_m = registered(depth_m, depth_camera, RigidTransform.identity(), rgb, camera)
    if len(cloud) == 0:
        raise FrameError(
            path,
            f"no pixel has a depth of confidence {least} or more, so the cloud is empty",
            "use the other frames, or give a lower --min-confidence",
        )
    return cloud, in_color_m


def rotation_of(quaternion: Sequence[float]) -> Rotation | None:
    """Returns the rotation of a quaternion x y z w; None if it is not one."""
    values = np.array(quaternion, np.float64)
    return Rotation.from_quat(values) if abs(np.linalg.norm(values) - 1) <= MOST_OFF_UNIT else None


def turns_to_upright(ups: Float64[np.ndarray, "n 3"]) -> int:
    """Returns how many quarter turns clockwise bring a recording's images upright, 0 if the camera looks down or up.

    Args:
        ups: unit vectors against gravity in the camera's frame, some of the recording's.
    """
    x, y = ups[:, :2].mean(axis=0) if len(ups) else (0.0, 0.0)
    return 0 if np.hypot(x, y) < LEAST_UPRIGHT else round(np.arctan2(-x, -y) / (np.pi / 2)) % 4


def turned(camera: Camera, turns: int) -> Camera:
    """Returns the camera (without distortion) of images that are turned clockwise by quarter turns."""
    for _ in range(turns):
        cx, cy = camera.height_px - 1 - camera.cy, camera.cx
        camera = Camera(camera.height_px, camera.width_px, camera.fy, camera.fx, cx, cy)
    return camera


def up_in_camera(world_from_camera: Rotation) -> Float64[np.ndarray, "3"]:
    """Returns the unit vector against gravity in the camera's frame, given its orientation in ARKit's world."""
    return np.asarray(world_from_camera.inv().apply(UP))
