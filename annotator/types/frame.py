"""One moment of a recording: a camera image and the point cloud that belongs to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from scipy.spatial.transform import RigidTransform

from annotator.types.camera import Camera
from annotator.types.checks import as_array
from annotator.types.point_cloud import PointCloud


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of a recording.

    Attributes:
        key: the frame's name within its recording, such as "000012"; unique and stable.
        index: position within the recording, from 0.
        camera: the colour camera.
        rgb: (H, W, 3) uint8 image of the colour camera, RGB order.
        cloud: all valid points, in the camera frame.
        depth_m: (H, W) float32 depth registered to the image, metres, 0 = no measurement; None for a LiDAR. If another
            camera measured it, the cloud has no `pixel_index`, and there are gaps between its pixels.
        up: unit vector against gravity in the camera frame; None if unknown.
        T_camera_label: from the frame in which the recording's own label files are written to the camera
            frame (KITTI: rectified camera 0; SUN RGB-D: upright depth); None if they are the same.
        timestamp_ns: capture time; None if unknown.
        T_camera_recorded: from the camera frame as the recording's files give it, to the corrected one; None if the
            project does not correct the calibration.
        T_world_camera: pose of the camera in map coordinates: those of the recording's clouds, or of its poses; None
            without such.
        exif_orientation: of the image file if `rgb` has its pixels as stored, not as viewers show them; else 1.
    """

    key: str
    index: int
    camera: Camera
    rgb: UInt8[np.ndarray, "h w 3"]
    cloud: PointCloud
    depth_m: Float32[np.ndarray, "h w"] | None = None
    up: Float64[np.ndarray, "3"] | None = None
    T_camera_label: RigidTransform | None = None
    timestamp_ns: int | None = None
    T_camera_recorded: RigidTransform | None = None
    T_world_camera: RigidTransform | None = None
    exif_orientation: int = 1

    def __post_init__(self) -> None:
        size = (self.camera.height_px, self.camera.width_px)
        object.__setattr__(self, "rgb", as_array("rgb", self.rgb, np.uint8, (*size, 3)))
        if self.depth_m is not None:
            object.__setattr__(self, "depth_m", as_array("depth_m", self.depth_m, np.float32, size))
        if self.up is not None:
            up = as_array("up", self.up, np.float64, (3,))
            object.__setattr__(self, "up", up / np.linalg.norm(up))
