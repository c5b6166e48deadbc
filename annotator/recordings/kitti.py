"""KITTI recordings: an image folder and a folder of LiDAR scans with the same keys.

object     [training/]image_2/KEY.png  velodyne/KEY.bin  calib/KEY.txt  [label_2/KEY.txt]; unrelated single frames
tracking   image_02/KEY.png  velodyne/KEY.bin  calib.txt  [label_02.txt]; consecutive frames of a drive, 10 a second; or
           the data set, where each drive is a scene:
           [training/]image_02/DRIVE/KEY.png  velodyne/DRIVE/KEY.bin  calib/DRIVE.txt  [label_02/DRIVE.txt]
raw        DRIVE/image_02/data/KEY.png  DRIVE/velodyne_points/data/KEY.bin  DRIVE/image_02/timestamps.txt
           calib_cam_to_cam.txt  calib_velo_to_cam.txt, in the drive's folder or in that of its day above it
           [tracklet_labels.xml]; the layout of the download ("synced and rectified")
odometry   image_2/KEY.png  velodyne/KEY.bin  calib.txt  [times.txt, poses.txt]; a sequence, read as a tracking folder

Poses, the first of: poses.txt, or poses/DRIVE.txt beside the sequences (odometry); oxts/data/KEY.txt (raw), oxts.txt or
oxts/DRIVE.txt (tracking); poses.csv, of the LiDAR. The odometry's are those of rectified camera 0, 3 x 4, in its first
frame, which is turned here so that z is up. A line of oxts begins with latitude and longitude (degrees), altitude
(metres), roll, pitch and yaw (0: east) of the GPS unit. As in the devkit, the world is the Mercator projection: x east,
y north, z up.

Labels are read by annotator.formats.kitti.

Calibration (object devkit, readme.txt): `px = P2 * R0_rect * Tr_velo_to_cam * X_lidar`, all row-major, in colour camera
2. The tracking files call two of the matrices R_rect and Tr_velo_cam and omit the colon. Raw drives (raw devkit,
readme.txt) have the same matrices in two files: P_rect_02 and R_rect_00, and the LiDAR's pose as R and T.

A frame's cloud holds the points in front of the camera that project inside the image, each with its reflectance and
the colour of the nearest pixel (exact except for the parallax between camera and LiDAR). The rest of a 360 degree scan
has no colour and no label, and is dropped.
"""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import cos, log, radians, tan
from pathlib import Path
from typing import ClassVar, Literal, TypeVar

import numpy as np
from jaxtyping import Float, Float64, UInt8
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.files import TABLE_BYTES, read_text_file
from annotator.geometry.projection import inside_image, project
from annotator.geometry.transforms import level_pose
from annotator.recordings.clouds.columns import RawCloud
from annotator.recordings.image_file import read_color_image
from annotator.recordings.listing import IMAGE_SUFFIXES, file_errors, frame_file, joined, sorted_keys, stems
from annotator.recordings.look_around import Scan, Scanned, Scenes, choose
from annotator.recordings.plausible import are_plausible, is_pinhole, is_rotation, pinhole
from annotator.recordings.poses import Poses, numbers, pose_of_matrix, read_poses
from annotator.recordings.recording import ReaderOptions
from annotator.recordings.scan_file import Scans
from annotator.text import spelled, to_number
from annotator.types import Camera, Frame, PointCloud
from annotator.types.checks import seconds_ns
from annotator.types.errors import ConfigError, FrameError, RecordingError

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
        T_lidar_imu: the GPS unit's frame (x ahead, y left, z up) to the LiDAR's; None if the calibration has it not.
    """

    path: Path
    matrix: Float64[np.ndarray, "3 3"]
    shift_m: Float64[np.ndarray, "3"]
    T_rect_lidar: Float64[np.ndarray, "3 4"]
    T_lidar_imu: RigidTransform | None = None

    @property
    def T_camera_label(self) -> RigidTransform:
        """The transform from rectified camera 0, the labels' frame, to colour camera 2."""
        return RigidTransform.from_translation(self.shift_m)

    @property
    def T_camera_lidar(self) -> RigidTransform:
        """The exactly rigid transform from the LiDAR to colour camera 2; `to_camera` uses the file's matrix instead."""
        return self.T_camera_label * rigid_of(self.T_rect_lidar)

    def camera(self, width_px: int, height_px: int) -> Camera:
        return pinhole(self.matrix, width_px, height_px)

    def to_camera(self, xyz_lidar_m: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Returns LiDAR points in the camera frame, metres."""
        xyz = xyz_lidar_m.astype(np.float64)
        shift = self.T_rect_lidar[:, 3] + self.shift_m
        return np.asarray(xyz @ self.T_rect_lidar[:, :3].T + shift)


def read_calibration(path: Path) -> KittiCalibration:
    rows = _read_rows(path)
    P2 = _matrix(path, rows, ("P2",), (3, 4))
    # the odometry's images are rectified, and its Tr leads to rectified camera 0
    R0 = np.eye(3) if "Tr" in rows else _matrix(path, rows, ("R0_rect", "R_rect"), (3, 3))
    Tr = _matrix(path, rows, ("Tr_velo_to_cam", "Tr_velo_cam", "Tr"), (3, 4))
    T_lidar_imu = None
    with suppress(FrameError):  # many converters write none, or zeros
        T_lidar_imu = _matrix(path, rows, ("Tr_imu_to_velo", "Tr_imu_velo"), (3, 4))
    return _calibration(path, path, P2, R0, Tr, T_lidar_imu)


def read_raw_calibration(cameras: Path, lidar: Path) -> KittiCalibration:
    """Reads the calibration of a raw drive: `calib_cam_to_cam.txt` and `calib_velo_to_cam.txt`."""
    rows, imu = _read_rows(cameras), lidar.with_name(IMU)
    P2 = _matrix(cameras, rows, ("P_rect_02",), (3, 4))
    R0 = _matrix(cameras, rows, ("R_rect_00",), (3, 3))
    T_lidar_imu = None
    with suppress(FrameError):  # it only says where the GPS unit is
        T_lidar_imu = _rigid_rows(imu) if imu.is_file() else None
    return _calibration(cameras, lidar, P2, R0, _rigid_rows(lidar), T_lidar_imu)


def _rigid_rows(path: Path) -> Float64[np.ndarray, "3 4"]:
    rows = _read_rows(path)
    return np.concatenate([_matrix(path, rows, ("R",), (3, 3)), _matrix(path, rows, ("T",), (3, 1))], axis=1)


def calibration_text(path: Path) -> str:
    if not path.exists():
        raise FrameError(path, "the calibration is missing", "copy it from the data set")
    with file_errors(path, REMEDY, "the calibration: "):
        return read_text_file(path)


def _read_rows(path: Path) -> dict[str, list[str]]:
    rows = {}
    for line in calibration_text(path).splitlines():
        name, *values = line.replace(":", " ", 1).split() or [""]
        rows[name] = values
    return rows


def _calibration(
    path: Path, lidar: Path, P2: np.ndarray, R0: np.ndarray, Tr: np.ndarray, T_lidar_imu: np.ndarray | None
) -> KittiCalibration:
    """Builds the calibration from the devkit's matrices; `path` is the file of the first two."""
    K = P2[:, :3]
    if not is_pinhole(K):
        raise FrameError(path, "P2 is not a pinhole camera (fx 0 cx / 0 fy cy / 0 0 1)", REMEDY)
    for place, name, R in ((path, "rectification", R0), (lidar, "LiDAR's pose", Tr[:, :3])):
        if not is_rotation(R, MOST_OFF_ROTATION):
            raise FrameError(place, f"the {name} is not a rotation", REMEDY)
    is_known = T_lidar_imu is not None and is_rotation(T_lidar_imu[:, :3], MOST_OFF_ROTATION)
    T_imu = rigid_of(T_lidar_imu) if T_lidar_imu is not None and is_known else None
    return KittiCalibration(path, K, np.linalg.solve(K, P2[:, 3]), R0 @ Tr, T_imu)


def rigid_of(matrix: Float64[np.ndarray, "3 4"]) -> RigidTransform:
    """Returns the exactly rigid transform nearest to one that is orthonormal to a few digits."""
    return RigidTransform.from_components(matrix[:, 3], Rotation.from_matrix(matrix[:, :3]))


def _matrix(path: Path, rows: dict[str, list[str]], names: tuple[str, ...], shape: tuple[int, int]) -> np.ndarray:
    name = next((name for name in names if name in rows), None)
    if name is None:
        raise FrameError(path, f"{' or '.join(names)} is missing", REMEDY)
    return matrix_of(path, name, rows[name], shape)


def matrix_of(path: Path, name: str, words: list[str], shape: tuple[int, int]) -> Float64[np.ndarray, "r c"]:
    """Returns the matrix called `name` whose elements are words, row by row."""
    with file_errors(path, REMEDY, f"{name}: "):
        values = np.array([to_number(word) for word in words])
    if values.size != shape[0] * shape[1]:
        raise FrameError(path, f"{name} must have {shape[0] * shape[1]} numbers, not {values.size}", REMEDY)
    if not are_plausible(values):
        raise FrameError(path, f"{name} has a number that is not finite or is too large", REMEDY)
    return values.reshape(shape)


NEAREST_Z_M = 0.1
# The rectified cameras are mounted upright on the car: their y axis points down.
UP = np.array([0.0, -1.0, 0.0])
T_WORLD_FIRST = level_pose(UP)
EARTH_M, ODOMETRY = 6378137.0, "poses.txt"


def odometry_poses(path: Path, calibration: KittiCalibration, keys: Sequence[str]) -> Poses:
    """Returns the poses of colour camera 2 in the file `path` of the odometry, a line for each number of a frame."""
    with file_errors(path, REMEDY, kind=RecordingError):
        lines = read_text_file(path, TABLE_BYTES).splitlines()
    poses: list[RigidTransform | None] = [None] * len(keys)
    for at, key in enumerate(keys):
        if is_number(key) and int(key) < len(lines):
            words, number = lines[int(key)].split(), int(key) + 1
            if len(words) != 12:
                raise RecordingError(
                    f"{path}:{number}: must be a 3 x 4 matrix, 12 numbers, not {len(words)}; correct or remove the file"
                )
            T_first_rect = pose_of_matrix(path, f"line {number}", numbers(path, number, words))
            poses[at] = T_WORLD_FIRST * T_first_rect * calibration.T_camera_label.inv()
    return Poses.of_frames(path.name, poses)


def visible_cloud(
    path: Path,
    camera: Camera,
    xyz_m: np.ndarray,
    raw: RawCloud,
    rgb: np.ndarray,
    remedy: str,
) -> PointCloud:
    """Returns the points (n, 3) in the camera frame that project inside the image.

    Without colours of their own, they have those of the nearest pixels. `path` and `remedy` are for the message if no
    point is seen.
    """
    in_front = xyz_m[:, 2] > NEAREST_Z_M
    px = project(camera, xyz_m[in_front])
    inside = inside_image(camera, px)
    if not inside.any():
        problem = f"none of its points lies in the image ({len(xyz_m)} in all), so the cloud is empty"
        raise FrameError(path, problem, remedy)
    chosen = np.flatnonzero(in_front)[inside]
    u, v = np.floor(px[inside] + 0.5).astype(np.int64).T
    colors = rgb[v, u] if raw.rgb is None else raw.rgb[chosen]
    reflectance = None if raw.reflectance is None else raw.reflectance[chosen]
    return PointCloud(xyz_m[chosen].astype(np.float32), rgb=colors, reflectance=reflectance)


# The rotating LiDAR triggers KITTI's sensors ten times a second.
PERIOD_NS = 100_000_000
# KITTI's names have 6 or 10 digits; times of longer numbers would not fit into 64 bits.
MOST_DIGITS = 10


def is_number(key: str) -> bool:
    return key.isascii() and key.isdigit() and len(key) <= MOST_DIGITS


@dataclass(frozen=True, eq=False)
class KittiFolder(Scanned):
    """A `Recording` of image and scan pairs, in two folders relative to `folder`: `path`, or its `training`.

    `poses` are those of colour camera 2, the LiDAR or the GPS unit, as `posed` says; None without any.
    """

    folder: Path
    images: str
    scans: str
    reader: Scans = field(default_factory=Scans, kw_only=True)
    poses: Poses | None = field(default=None, kw_only=True)
    posed: Literal["camera", "lidar", "imu"] = field(default="lidar", kw_only=True)
    # of a file of times in `root`
    times_name: ClassVar[str] = ""
    is_parallel: ClassVar[bool] = True

    @property
    def root(self) -> Path:
        return self.folder

    def files(self, i: int) -> tuple[Path, Path]:
        key = self.key(i)
        image = frame_file(self.root / self.images, key, IMAGE_SUFFIXES, f"{self.scans}/{key}.bin")
        return image, self._scan_file(key)

    def image(self, i: int) -> UInt8[np.ndarray, "h w 3"]:
        return read_color_image(self.files(i)[0]).rgb

    def frame(self, i: int) -> Frame:
        """Reads frame `i`; labels are in rectified camera 0 (`T_camera_label`)."""
        key, (_, scan) = self.key(i), self.files(i)
        rgb, calibration, raw = self.image(i), self.calibration(key), self.reader.read(scan)
        camera = calibration.camera(rgb.shape[1], rgb.shape[0])
        remedy = f"check that {calibration.path} belongs to this scan"
        cloud = visible_cloud(scan, camera, calibration.to_camera(raw.xyz_m), raw, rgb, remedy)
        T, time_ns = calibration.T_camera_label, self._time_of(i)
        return Frame(key, i, camera, rgb, cloud, None, UP, T, time_ns, T_world_camera=self.pose(i))

    @property
    def pose_source(self) -> str | None:
        return None if self.poses is None else self.poses.source

    def pose(self, i: int) -> RigidTransform | None:
        key = self.key(i)
        T = None if self.poses is None else self.poses.at(i, self._time_of(i))
        if T is None or self.posed == "camera":
            return T
        calibration = self.calibration(key)
        if self.posed == "imu":
            T = None if calibration.T_lidar_imu is None else T * calibration.T_lidar_imu.inv()
        return None if T is None else T * calibration.T_camera_lidar.inv()

    def oxts(self, key: str) -> tuple[Path, int] | None:
        """Returns the file of a frame's GPS, and the line in it, from 0; None for formats without."""
        return None

    def scan(self, i: int) -> Scan:
        key = self.key(i)
        calibration, T_world_camera = self.calibration(key), self.pose(i)
        return Scan(
            lambda: self.reader.read(self._scan_file(key)),
            level_pose(UP).rotation * calibration.T_camera_lidar.rotation,
            np.zeros(3),
            calibration.T_camera_lidar.inv() * calibration.T_camera_label,
            timestamp_ns=self._time_of(i),
            T_world_scan=None if T_world_camera is None else T_world_camera * calibration.T_camera_lidar,
        )

    def _scan_file(self, key: str) -> Path:
        return frame_file(self.root / self.scans, key, (".bin",), f"the image {key}")

    @property
    def times_ns(self) -> tuple[int | None, ...] | None:
        """The frames' times; None if the keys are no numbers."""
        if not all(key.isascii() and key.isdigit() for key in self.keys):
            return None
        return tuple(self.time_ns(int(key)) for key in self.keys)

    def _time_of(self, i: int) -> int | None:
        """Returns the time of frame `i`: the key's number determines it, so gaps are kept."""
        key = self.keys[i]
        return self.time_ns(int(key) if is_number(key) else i)

    @abstractmethod
    def calibration(self, key: str) -> KittiCalibration:
        """Reads the calibration of a frame."""

    def time_ns(self, number: int) -> int | None:
        """Returns the time of frame `number` of the drive, else that since its frame 0; None if frames have no time."""
        times, path = self._times, self.root / self.times_name
        if times is None:
            return number * PERIOD_NS
        time_ns = times[number] if number < len(times) else None
        if time_ns is None:
            raise FrameError(
                path,
                f"line {number + 1} must be the time of frame {number}",
                "copy it again, or remove it to use times from the frame numbers",
            )
        return time_ns

    @cached_property
    def _times(self) -> tuple[int | None, ...] | None:
        """The time of each line, nanoseconds; None for an invalid line. None without the file."""
        path = self.root / self.times_name
        if not self.times_name or not path.is_file():
            return None
        with file_errors(path, "copy it again from the data set"):
            return tuple(self.time_of(line.strip()) for line in read_text_file(path, TABLE_BYTES).splitlines())

    @staticmethod
    def time_of(line: str) -> int | None:
        """Returns the time in a line of the file of times, nanoseconds; None if it has none."""
        with suppress(ValueError):
            return seconds_ns(line)
        return None


Kitti = TypeVar("Kitti", bound=KittiFolder)


def _with_poses(recording: Kitti, *odometry: Path) -> Kitti:
    """Returns a recording with the poses of the first of these files of the odometry, else of oxts or poses.csv."""
    file = next((path for path in odometry if path.is_file()), None)
    with suppress(FrameError):  # of a calibration, or of a file of times, which each frame reports
        if file is not None:
            poses = odometry_poses(file, recording.calibration(recording.keys[0]), recording.keys)
            return replace(recording, poses=poses, posed="camera")
        if (gps := _oxts_poses(recording)) is not None:
            return replace(recording, poses=gps, posed="imu")
        return replace(recording, poses=read_poses(recording.root, recording.keys, recording.times_ns))
    return recording


def _oxts_poses(recording: KittiFolder) -> Poses | None:
    """Returns the poses of the GPS unit, in a projection with the scale of the first one's latitude; None without."""
    files, rows = dict[Path, list[str]](), list[list[float] | None]()
    for place in map(recording.oxts, recording.keys):
        if place is None:
            rows.append(None)
            continue
        file, at = place
        if file not in files:
            with file_errors(file, REMEDY, kind=RecordingError):
                files[file] = read_text_file(file, TABLE_BYTES).splitlines() if file.is_file() else []
        rows.append(_oxts_row(file, at + 1, files[file][at].split()) if at < len(files[file]) else None)
    scale = next((cos(radians(row[0])) for row in rows if row is not None), None)
    if scale is None:
        return None
    found = next(file for file in files if files[file])
    source = (found.parent if len(files) > 1 else found).relative_to(recording.root).as_posix()
    return Poses.of_frames(source, [None if row is None else _oxts_pose(row, scale * EARTH_M) for row in rows])


def _oxts_row(path: Path, line: int, words: Sequence[str]) -> list[float]:
    """Returns latitude, longitude (degrees), altitude (metres), roll, pitch and yaw (radians) of a line of oxts."""
    row = numbers(path, line, words[:6])
    if len(row) < 6 or not are_plausible(np.array(row)) or not -89 < row[0] < 89:
        raise RecordingError(
            f"{path}:{line}: must begin with latitude, longitude, altitude, roll, pitch, yaw; {REMEDY}"
        )
    return row


def _oxts_pose(row: Sequence[float], earth_m: float) -> RigidTransform:
    lat, lon, up_m, roll, pitch, yaw = row
    place_m = np.array([earth_m * radians(lon), earth_m * log(tan(radians(90 + lat) / 2)), up_m])
    return RigidTransform.from_components(place_m, Rotation.from_euler("ZYX", [yaw, pitch, roll]))


def keys_in(root: Path, images: str, scans: str) -> tuple[str, ...] | None:
    if not ((root / images).is_dir() and (root / scans).is_dir()):
        return None
    expected = f"{images}/KEY.png and {scans}/KEY.bin"
    keys = joined(stems(root / images, IMAGE_SUFFIXES), stems(root / scans, (".bin",)))
    return sorted_keys(root, keys, expected)


def require_calibration(root: Path, looks_like: str, name: str, scans: str) -> None:
    """Refuses a folder of images and scans without a calibration, in place of an error for each frame."""
    if not (root / name).exists():
        raise RecordingError(
            f"{root}: looks like {looks_like}: {name} is missing; copy it from the data set, or give the path of "
            f"{scans} to label the scans without images"
        )


IMAGES, SCANS = "image_02", "velodyne"


@dataclass(frozen=True, eq=False)
class KittiObject(KittiFolder):
    """A `Recording` of a KITTI object folder."""

    format: ClassVar[str] = "kitti_object"
    is_sequence: ClassVar[bool] = False

    def calibration(self, key: str) -> KittiCalibration:
        return read_calibration(spelled(self.root / "calib", f"{key}.txt"))

    def time_ns(self, number: int) -> None:
        """Unrelated frames have no time."""


def open_kitti_object(path: Path, options: ReaderOptions) -> KittiObject | None:
    """Opens the KITTI object folder at `path` or `path`/training; None if there is none."""
    for root in (path, path / "training"):
        keys = keys_in(root, "image_2", SCANS)
        if keys is not None:
            if not (root / "calib").exists() and (root / "calib.txt").is_file():
                return None  # of the odometry
            require_calibration(root, "a KITTI object folder", "calib/", "velodyne/")
            return _with_poses(KittiObject(path, keys, root, "image_2", SCANS, reader=Scans(options.columns)))
    return None


CAMERAS, LIDAR, IMU = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt"
# Of the years that 64 bits of nanoseconds hold; numpy would wrap others, and read "2011" or "now".
TIME = re.compile(r"(?:19[7-9]|20\d)\d-\d\d-\d\d \d\d:\d\d:\d\d(?:\.\d{1,9})?")


@dataclass(frozen=True, eq=False)
class KittiRaw(KittiFolder):
    """A `Recording` of one KITTI raw drive.

    Times come from `timestamps.txt`, read as UTC; its first line is the drive's frame 0.
    """

    format: ClassVar[str] = "kitti_raw"
    is_sequence: ClassVar[bool] = True

    def calibration(self, key: str) -> KittiCalibration:
        for folder in (self.path, self.path.resolve().parent):
            if (folder / CAMERAS).is_file() or (folder / LIDAR).is_file():
                return read_raw_calibration(folder / CAMERAS, folder / LIDAR)
        raise FrameError(
            self.path / CAMERAS, "the calibration is missing", f"copy {CAMERAS} and {LIDAR} of the drive's day there"
        )

    times_name: ClassVar[str] = "image_02/timestamps.txt"

    def oxts(self, key: str) -> tuple[Path, int]:
        return self.path / "oxts" / "data" / f"{key}.txt", 0

    @staticmethod
    def time_of(line: str) -> int | None:
        try:
            return int(np.datetime64(line, "ns").astype(np.int64)) if TIME.fullmatch(line) else None
        except ValueError:  # such as the 31st of February
            return None


def open_kitti_raw(path: Path, options: ReaderOptions) -> KittiRaw | None:
    """Opens the KITTI raw drive at `path`; None if it is not one. Takes the option `columns`."""
    places = "image_02/data", "velodyne_points/data"
    keys = keys_in(path, *places)
    return None if keys is None else _with_poses(KittiRaw(path, keys, path, *places, reader=Scans(options.columns)))


@dataclass(frozen=True, eq=False)
class KittiTracking(KittiFolder, Scenes):
    """A `Recording` of one KITTI drive, or of a sequence of the odometry; its times count from the drive's frame 0.

    `scene` is the drive's name within a data set, "" for a folder of one drive.
    """

    scene: str = ""
    scenes: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    times_name: ClassVar[str] = "times.txt"
    format: ClassVar[str] = "kitti_tracking"
    is_sequence: ClassVar[bool] = True

    @property
    def name(self) -> str:
        return self.scene or super().name

    @property
    def label_file(self) -> Path:
        """The file of the labels, which may be missing."""
        return self._of_drive("label_02")

    def calibration(self, key: str) -> KittiCalibration:
        return read_calibration(self._of_drive("calib"))

    def oxts(self, key: str) -> tuple[Path, int] | None:
        return (self._of_drive("oxts"), int(key)) if is_number(key) else None

    def _of_drive(self, kind: str) -> Path:
        return self.root / kind / f"{self.scene}.txt" if self.scene else self.root / f"{kind}.txt"


def open_kitti_tracking(path: Path, options: ReaderOptions) -> KittiTracking | None:
    """Opens the KITTI tracking folder at `path`, or a drive of the data set there; None if it is neither.

    Takes the options `columns` and, of a data set, `scene`; without it, the first drive is read.
    """
    for root in (path, path / "training"):
        drives = _drives(root)
        if drives:
            return _sequence(path, root, drives, options)
    images = IMAGES if (path / IMAGES).is_dir() else "image_2"
    keys = keys_in(path, images, SCANS)
    if keys is None:
        return None
    if options.scene is not None:
        raise ConfigError(f"{path}: is one drive of KITTI, which takes no --scene")
    require_calibration(path, "a KITTI tracking folder", "calib.txt", "velodyne/")
    drive = KittiTracking(path, keys, path, images, SCANS, reader=Scans(options.columns))
    here = path.resolve()
    return _with_poses(drive, path / ODOMETRY, here.parent.parent / "poses" / f"{here.name}.txt")


def _drives(root: Path) -> list[str]:
    if not (root / IMAGES).is_dir():
        return []
    return sorted(file.stem for file in (root / "calib").glob("*.txt") if (root / IMAGES / file.stem).is_dir())


def _sequence(path: Path, root: Path, drives: list[str], options: ReaderOptions) -> KittiTracking:
    scene, notes = choose(path, "scene", options.scene, drives, drives[0])
    images, scans = f"{IMAGES}/{scene}", f"{SCANS}/{scene}"
    keys = keys_in(root, images, scans) or sorted_keys(root, set(), f"{images}/KEY.png and {scans}/KEY.bin")
    reader = Scans(options.columns)
    return _with_poses(KittiTracking(path, keys, root, images, scans, scene, tuple(drives), notes, reader=reader))
