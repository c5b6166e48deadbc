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
from annotator.recordings.plausible import LARGEST
from annotator.types import Camera, Frame, PointCloud
from annotator.types.errors import FrameError

NEAREST_Z_M = 0.1
BYTES_PER_POINT = 16
# The rectified cameras are mounted upright on the car: their y axis points down.
UP = np.array([0.0, -1.0, 0.0])


def read_frame(
    key: str,
    index: int,
    image_path: Path,
    scan_path: Path,
    calibration: KittiCalibration,
    timestamp_ns: int | None,
) -> Frame:
    """Reads the frame of an image and a scan; `camera` is colour camera 2.

    Raises:
        FrameError: a missing or broken file, or no point in the image.
    """
    rgb = read_rgb(image_path)
    camera = calibration.camera(rgb.shape[1], rgb.shape[0])
    scan = read_scan(scan_path)
    cloud = visible_cloud(camera, calibration.to_camera(scan[:, :3]), scan[:, 3], rgb)
    if len(cloud) == 0:
        raise FrameError(
            scan_path,
            f"none of its {len(scan)} points lies in the image, so the cloud is empty",
            f"check that {calibration.path} belongs to this scan",
        )
    return Frame(key, index, camera, rgb, cloud, None, UP, calibration.T_camera_label, timestamp_ns)


def read_scan(path: Path) -> np.ndarray:
    """Returns the valid points of a Velodyne `.bin`: (n, 4) float32 x y z reflectance, LiDAR frame, metres.

    Points with a value that is NaN, infinite or beyond `LARGEST` are left out.

    Raises:
        FrameError: the file is missing, empty, truncated, or has no valid point.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FrameError(path, f"the scan cannot be read ({error.strerror})", "copy it from the data set") from error
    if not data:
        raise FrameError(path, "the file is empty", "copy the scan again from the data set")
    if len(data) % BYTES_PER_POINT:
        raise FrameError(
            path,
            f"the scan is truncated: {len(data)} bytes are not a multiple of {BYTES_PER_POINT} (4 float32 per point)",
            "copy it again from the data set",
        )
    points = np.frombuffer(data, "<f4").reshape(-1, 4)
    # false also for infinity and NaN
    points = points[(np.abs(points) < LARGEST).all(axis=1)]
    if len(points) == 0:
        raise FrameError(path, "every point is NaN or infinite", "copy the scan again from the data set")
    return points


def visible_cloud(camera: Camera, xyz_m: np.ndarray, reflectance: np.ndarray, rgb: np.ndarray) -> PointCloud:
    """Returns the points (n, 3) in the camera frame that project inside the image, coloured by the nearest pixel."""
    in_front = xyz_m[:, 2] > NEAREST_Z_M
    xyz_m, reflectance = xyz_m[in_front], reflectance[in_front]
    px = project(camera, xyz_m)
    inside = inside_image(camera, px)
    u, v = np.floor(px[inside] + 0.5).astype(np.int64).T
    return PointCloud(xyz_m[inside].astype(np.float32), rgb=rgb[v, u], reflectance=reflectance[inside])
