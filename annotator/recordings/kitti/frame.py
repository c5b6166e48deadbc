"""Reads a KITTI frame from its three files: image, LiDAR scan, calibration.

The cloud holds the points in front of the camera that project inside the image, each with its reflectance and the
colour of the nearest pixel (exact except for the parallax between camera and LiDAR). The rest of a 360 degree scan has
no colour and no label, and is dropped.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from annotator.geometry.projection import inside_image, project
from annotator.recordings.image_file import read_rgb
from annotator.recordings.kitti.calibration import KittiCalibration
from annotator.recordings.scan_file import Scans
from annotator.types import Camera, Frame, PointCloud
from annotator.types.errors import FrameError

NEAREST_Z_M = 0.1
# The rectified cameras are mounted upright on the car: their y axis points down.
UP = np.array([0.0, -1.0, 0.0])


def read_frame(
    key: str,
    index: int,
    image_path: Path,
    scan_path: Path,
    scans: Scans,
    calibration: KittiCalibration,
    timestamp_ns: int | None,
) -> Frame:
    """Reads the frame of an image and a scan; `camera` is colour camera 2.

    Raises:
        FrameError: a missing or broken file, or no point in the image.
    """
    rgb = read_rgb(image_path)
    camera = calibration.camera(rgb.shape[1], rgb.shape[0])
    scan = scans.read(scan_path)
    cloud = visible_cloud(camera, calibration.to_camera(scan.xyz_m), scan.reflectance, rgb)
    if len(cloud) == 0:
        raise FrameError(
            scan_path,
            f"none of its points lies in the image ({len(scan.xyz_m)} in all), so the cloud is empty",
            f"check that {calibration.path} belongs to this scan",
        )
    return Frame(key, index, camera, rgb, cloud, None, UP, calibration.T_camera_label, timestamp_ns)


def visible_cloud(camera: Camera, xyz_m: np.ndarray, reflectance: np.ndarray | None, rgb: np.ndarray) -> PointCloud:
    """Returns the points (n, 3) in the camera frame that project inside the image, coloured by the nearest pixel."""
    in_front = xyz_m[:, 2] > NEAREST_Z_M
    px = project(camera, xyz_m[in_front])
    inside = inside_image(camera, px)
    chosen = np.flatnonzero(in_front)[inside]
    u, v = np.floor(px[inside] + 0.5).astype(np.int64).T
    seen = None if reflectance is None else reflectance[chosen]
    return PointCloud(xyz_m[chosen].astype(np.float32), rgb=rgb[v, u], reflectance=seen)
