"""Frames of KITTI: image, LiDAR scan, and the calibration that projects the scan into colour camera 2.

KITTI object devkit, readme.txt ("Calibration"): `px = P2 * R0_rect * Tr_velo_to_cam * X_lidar`, all row-major. The
tracking files call two of the matrices R_rect and Tr_velo_cam and omit the colon. Raw drives (raw devkit, readme.txt)
have the same matrices in two files: P_rect_02 and R_rect_00, and the LiDAR's pose as R and T.

A frame's cloud holds the points in front of the camera that project inside the image, each with its reflectance and
the colour of the nearest pixel (exact except for the parallax between camera and LiDAR). The rest of a 360 degree scan
has no colour and no label, and is dropped.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.files import read_text_file
from annotator.geometry.projection import inside_image, project
from annotator.recordings.image_file import read_rgb
from annotator.recordings.plausible import are_plausible, is_pinhole, is_rotation
from annotator.recordings.scan_file import Scans
from annotator.text import to_number
from annotator.types import Camera, Frame, PointCloud
from annotator.types.errors import FrameError

P2_NAMES = ("P2",)
RECTIFICATION_NAMES = ("R0_rect", "R_rect")
LIDAR_NAMES = ("Tr_velo_to_cam", "Tr_velo_cam")
RAW_P2_NAMES, RAW_RECTIFICATION_NAMES = ("P_rect_02",), ("R_rect_00",)
# Tolerance for rotations: files have four digits or more.
MOST_OFF_ROTATION = 1e-2
REMEDY = "copy the calibration file again from the data set"


@dataclass(frozen=True, eq=False)
class KittiCalibration:
    """The calibration of one frame.

    The `camera` frame is that of colour camera 2, an ideal pinhole with the K of P2. KITTI's labels are in the frame
    of rectified camera 0, which P2 = K [I | t] shifts by t. No component of t is zero.

    Attributes:
        path: the file.
        matrix: (3, 3) K of P2.
        shift_m: (3,) t = K^-1 P2[:, 3].
        T_rect_lidar: (3, 4) R0_rect * Tr_velo_to_cam: LiDAR to rectified camera 0, as in the file. Not a
            RigidTransform, because it is orthonormal only to seven digits and products must equal the data set's own.
    """

    path: Path
    matrix: Float64[np.ndarray, "3 3"]
    shift_m: Float64[np.ndarray, "3"]
    T_rect_lidar: Float64[np.ndarray, "3 4"]

    @property
    def T_camera_label(self) -> RigidTransform:
        """The transform from rectified camera 0, the labels' frame, to colour camera 2."""
        return RigidTransform.from_translation(self.shift_m)

    @property
    def T_camera_lidar(self) -> RigidTransform:
        """The exactly rigid transform from the LiDAR to colour camera 2; `to_camera` uses the file's matrix instead."""
        rotation = Rotation.from_matrix(self.T_rect_lidar[:, :3])
        return RigidTransform.from_components(self.T_rect_lidar[:, 3] + self.shift_m, rotation)

    def camera(self, width_px: int, height_px: int) -> Camera:
        """Returns colour camera 2 for an image of this size."""
        K = self.matrix
        return Camera(width_px, height_px, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))

    def to_camera(self, xyz_lidar_m: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Returns LiDAR points in the camera frame, metres."""
        xyz = xyz_lidar_m.astype(np.float64)
        shift = self.T_rect_lidar[:, 3] + self.shift_m
        return np.asarray(xyz @ self.T_rect_lidar[:, :3].T + shift)


def read_calibration(path: Path) -> KittiCalibration:
    """Reads the calibration of a KITTI object or tracking file."""
    rows = _read_rows(path)
    P2 = _matrix(path, rows, P2_NAMES, (3, 4))
    R0 = _matrix(path, rows, RECTIFICATION_NAMES, (3, 3))
    return _calibration(path, path, P2, R0, _matrix(path, rows, LIDAR_NAMES, (3, 4)))


def read_raw_calibration(cameras: Path, lidar: Path) -> KittiCalibration:
    """Reads the calibration of a raw drive: `calib_cam_to_cam.txt` and `calib_velo_to_cam.txt`."""
    rows, poses = _read_rows(cameras), _read_rows(lidar)
    P2 = _matrix(cameras, rows, RAW_P2_NAMES, (3, 4))
    R0 = _matrix(cameras, rows, RAW_RECTIFICATION_NAMES, (3, 3))
    Tr = np.concatenate([_matrix(lidar, poses, ("R",), (3, 3)), _matrix(lidar, poses, ("T",), (3, 1))], axis=1)
    return _calibration(cameras, lidar, P2, R0, Tr)


def calibration_text(path: Path) -> str:
    """Returns the text of a calibration file."""
    try:
        return read_text_file(path)
    except FileNotFoundError as error:
        raise FrameError(path, "the calibration is missing", "copy it from the data set") from error
    except (OSError, UnicodeDecodeError) as error:
        raise FrameError(path, f"the calibration cannot be read ({error})", REMEDY) from error


def _read_rows(path: Path) -> dict[str, list[str]]:
    """Returns the values of each line of a calibration file, by the name before them."""
    rows = {}
    for line in calibration_text(path).splitlines():
        name, *values = line.replace(":", " ", 1).split() or [""]
        rows[name] = values
    return rows


def _calibration(path: Path, lidar: Path, P2: np.ndarray, R0: np.ndarray, Tr: np.ndarray) -> KittiCalibration:
    """Builds the calibration from the devkit's three matrices; `path` is the file of the first two."""
    K = P2[:, :3]
    if not is_pinhole(K):
        raise FrameError(path, "P2 is not a pinhole camera (fx 0 cx / 0 fy cy / 0 0 1)", REMEDY)
    for place, name, R in ((path, "rectification", R0), (lidar, "LiDAR's pose", Tr[:, :3])):
        if not is_rotation(R, MOST_OFF_ROTATION):
            raise FrameError(place, f"the {name} is not a rotation", REMEDY)
    return KittiCalibration(path, K, np.linalg.solve(K, P2[:, 3]), R0 @ Tr)


def _matrix(path: Path, rows: dict[str, list[str]], names: tuple[str, ...], shape: tuple[int, int]) -> np.ndarray:
    name = next((name for name in names if name in rows), None)
    if name is None:
        raise FrameError(path, f"{' or '.join(names)} is missing", REMEDY)
    try:
        values = np.array([to_number(value) for value in rows[name]])
    except ValueError as error:
        raise FrameError(path, f"{name}: {error}", REMEDY) from error
    if values.size != shape[0] * shape[1]:
        raise FrameError(path, f"{name} must have {shape[0] * shape[1]} numbers, not {values.size}", REMEDY)
    if not are_plausible(values):
        raise FrameError(path, f"{name} has a number that is not finite or is too large", REMEDY)
    return values.reshape(shape)


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
    """Reads the frame of an image and a scan; `camera` is colour camera 2."""
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
