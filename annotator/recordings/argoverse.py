"""Argoverse 2's sensor data set: one log, seen by one of its cameras, or by a virtual one if it has no images.

sensors/lidar/TIME_NS.feather              x y z (metres, ego frame at that time), intensity (0..255)
sensors/cameras/CAMERA/TIME_NS.jpg         optional, without distortion
calibration/intrinsics.feather             fx_px fy_px cx_px cy_px of each camera
calibration/egovehicle_SE3_sensor.feather  the sensors' poses on the vehicle: quaternion w x y z, metres
city_SE3_egovehicle.feather                the vehicle's poses at the times of all images and sweeps; z is up
[annotations.feather, read by annotator.formats.argoverse]

A frame is a sweep with the image nearest in time. The vehicle's poses at both times move the sweep to the image's time.
k1 k2 k3 of the intrinsics belong to the images before they were undistorted, and are not read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import UInt8
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.fenced_files import Kind, read_feather
from annotator.recordings.clouds.cloud_folder import VIRTUAL_CAMERA
from annotator.recordings.clouds.columns import RawCloud, from_columns
from annotator.recordings.frame_times import nearest
from annotator.recordings.image_file import read_color_image
from annotator.recordings.kitti import visible_cloud
from annotator.recordings.listing import IMAGE_SUFFIXES, file_errors, frame_file, require_size, sorted_keys, stems
from annotator.recordings.look_around import R_CAMERA_LEVEL, RigCamera, Scan, Scanned, choose, level_turn, virtual_frame
from annotator.recordings.plausible import LARGEST_SIDE_PX, are_plausible, is_pinhole, pinhole
from annotator.recordings.recording import ReaderOptions
from annotator.types import Camera, Frame
from annotator.types.checks import LATEST_NS, too_late
from annotator.types.errors import FrameError, RecordingError
from annotator.types.messages import amount, first_few

SWEEPS, CAMERAS = "sensors/lidar", "sensors/cameras"
POSES, MOUNTS, INTRINSICS = (
    "city_SE3_egovehicle.feather",
    "calibration/egovehicle_SE3_sensor.feather",
    "calibration/intrinsics.feather",
)
FRONT, LIDAR = "ring_front_center", "up_lidar"
REMEDY = "copy it again from the data set"
MOST_INTENSITY = 255
# Half the period of the LiDAR.
TOLERANCE_S = 0.05
# 64 bits have 19 digits.
LONGEST_TIME = 19
POSE = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
# Rows that a message names.
MOST_NAMED = 12
UP, AHEAD = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class ArgoverseLog(Scanned, RigCamera):
    """A `Recording` of a log's sweeps, in time order; labels are in the ego frame of the sweep's time.

    Attributes:
        camera: "" for the virtual one of a log without images.
        images: the time of each frame's image, as in its file's name; empty without images.
        poses: of the vehicle, by time.
    """

    camera: str
    cameras: tuple[str, ...]
    images: tuple[str, ...]
    poses: dict[int, np.ndarray] = field(repr=False)
    notes: tuple[str, ...] = ()
    format: ClassVar[str] = "argoverse2"
    is_sequence: ClassVar[bool] = True

    @property
    def name(self) -> str:
        return f"{self.path.resolve().name}@{self.camera}" if self.camera else self.path.resolve().name

    def files(self, i: int) -> tuple[Path, ...]:
        key = self.key(i)
        if not self.camera:
            return (self._sweep_file(key),)
        folder = self.path / CAMERAS / self.camera
        return self._sweep_file(key), frame_file(folder, self.images[i], IMAGE_SUFFIXES, f"the sweep {key}")

    def image(self, i: int) -> UInt8[np.ndarray, "h w 3"]:
        if not self.camera:
            return super().image(i)
        return read_color_image(self.files(i)[1], (self._intrinsics.width_px, self._intrinsics.height_px)).rgb

    def frame(self, i: int) -> Frame:
        """Reads frame `i`; its cloud holds the points inside the image, or all without images."""
        key = self.key(i)
        if not self.camera:
            return virtual_frame(self.scan(i), key, i, VIRTUAL_CAMERA, R_CAMERA_LEVEL)
        sweep, image = self.files(i)
        camera = self._intrinsics
        size = camera.width_px, camera.height_px
        picture = read_color_image(image, size)
        require_size(image, picture.rgb, size, "the calibration says", REMEDY)
        T_city_camera = self._T_city_camera(i)
        T_camera_ego = T_city_camera.inv() * self._T_city_ego(key)
        raw = self._sweep(key)
        xyz_m = T_camera_ego.apply(raw.xyz_m)
        cloud = visible_cloud(sweep, camera, xyz_m, raw, picture.rgb, f"check {MOUNTS} and {POSES}")
        up = T_city_camera.rotation.inv().apply(UP)
        moment = {"timestamp_ns": int(self.images[i]), "T_world_camera": T_city_camera}
        return picture.frame(key, i, camera, cloud, up=up, T_camera_label=T_camera_ego, **moment)

    def scan(self, i: int) -> Scan:
        key = self.key(i)
        T_city_ego = self._T_city_ego(key)
        up = T_city_ego.rotation.inv().apply(UP)
        place_m = self._mount(LIDAR).translation
        R_level_ego, T_ego_label = level_turn(up, AHEAD), RigidTransform.identity()
        return Scan(lambda: self._sweep(key), R_level_ego, place_m, T_ego_label, True, int(key), T_city_ego)

    @property
    def pose_source(self) -> str:
        return POSES

    def pose(self, i: int) -> RigidTransform:
        self.key(i)
        T = self._T_city_camera(i) if self.camera else self.scan(i).T_world_camera(R_CAMERA_LEVEL)
        assert T is not None
        return T

    def moment(self, i: int) -> str:
        return self.key(i)

    def T_rig_camera(self, i: int) -> RigidTransform:
        """Returns the camera's pose in the ego frame of the sweep's time."""
        return self._T_city_ego(self.key(i)).inv() * self._T_city_camera(i)

    def _sweep_file(self, key: str) -> Path:
        return self.path / SWEEPS / f"{key}.feather"

    def _sweep(self, key: str) -> RawCloud:
        """Returns the valid points in the ego frame."""
        path = self._sweep_file(key)
        columns = _table(path, {"x": "float", "y": "float", "z": "float", "intensity": "int"})
        columns["intensity"] = columns["intensity"].clip(0, MOST_INTENSITY).astype(np.uint8)
        with file_errors(path, REMEDY):
            return from_columns(columns)

    def _T_city_camera(self, i: int) -> RigidTransform:
        return self._T_city_ego(self.images[i]) * self._mount(self.camera)

    def _T_city_ego(self, time_ns: str) -> RigidTransform:
        return _rigid(self.path / POSES, time_ns, self.poses, int(time_ns))

    def _mount(self, sensor: str) -> RigidTransform:
        return _rigid(self.path / MOUNTS, sensor, self._mounts, sensor)

    @cached_property
    def _mounts(self) -> dict[str, np.ndarray]:
        return _rows(self.path / MOUNTS, "sensor_name", "text", POSE)

    @cached_property
    def _intrinsics(self) -> Camera:
        path = self.path / INTRINSICS
        rows = _rows(path, "sensor_name", "text", ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px"))
        fx, fy, cx, cy, width_px, height_px = _row(path, self.camera, rows, self.camera).tolist()
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        if not (is_pinhole(K) and 1 <= min(width_px, height_px) <= max(width_px, height_px) <= LARGEST_SIDE_PX):
            raise FrameError(path, f"{self.camera} is not a pinhole camera", REMEDY)
        return pinhole(K, int(width_px), int(height_px))


def open_argoverse2(path: Path, options: ReaderOptions) -> ArgoverseLog | None:
    """Opens the log at `path`; None if it is not one. Without the option `camera`, the front one is read."""
    if not is_argoverse2(path):
        return None
    keys = sorted_keys(path, _times(path / SWEEPS, (".feather",)), f"{SWEEPS}/TIME_NS.feather")
    poses = _rows(path / POSES, "timestamp_ns", "int", POSE)
    folders = sorted(folder.name for folder in (path / CAMERAS).glob("*/")) if (path / CAMERAS).is_dir() else []
    times = {name: _times(path / CAMERAS / name, IMAGE_SUFFIXES) for name in folders}
    cameras = tuple(name for name in folders if times[name])
    usual = FRONT if FRONT in cameras else next(iter(cameras), "")
    camera, notes = choose(path, "camera", options.camera, cameras, usual)
    if not camera:
        return ArgoverseLog(path, keys, "", (), (), poses, (f"{CAMERAS}/ has no images; a virtual camera looks ahead",))
    within_s = options.tolerance_s or TOLERANCE_S
    pairs = _pairs(keys, times[camera], within_s)
    if not pairs:
        raise RecordingError(f"{path}: no frames; no image of {camera} is within {within_s:g} s of a sweep")
    if alone := len(keys) - len(pairs):
        without = f"{amount(alone, 'sweep')} without an image within {within_s:g} s"
        notes += (f"left out: {without} (--tolerance changes it)",)
    return ArgoverseLog(path, tuple(pairs), camera, cameras, tuple(pairs.values()), poses, notes)


def is_argoverse2(path: Path) -> bool:
    return (path / SWEEPS).is_dir() and (path / POSES).is_file()


def _times(folder: Path, suffixes: tuple[str, ...]) -> set[str]:
    names = {name for name in stems(folder, suffixes) if name.isdecimal() and len(name) <= LONGEST_TIME}
    late = sorted(name for name in names if int(name) > LATEST_NS)
    if late:
        raise RecordingError(f"{folder}: the file {late[0]}: {too_late(late[0], 'ns')}; remove it")
    return names


def _pairs(keys: Sequence[str], images: set[str], within_s: float) -> dict[str, str]:
    names = sorted(images, key=int)
    near = nearest(np.array([int(key) for key in keys]), np.array([int(name) for name in names]))
    found = {key: names[at] for key, at in zip(keys, near.tolist(), strict=True)}
    return {key: name for key, name in found.items() if abs(int(name) - int(key)) <= within_s * 1e9}


def _table(path: Path, columns: dict[str, Kind]) -> dict[str, np.ndarray]:
    with file_errors(path, REMEDY):
        return read_feather(path, columns)


def _rows(path: Path, name: str, kind: Kind, columns: tuple[str, ...]) -> dict[Any, np.ndarray]:
    """Returns the numbers of each row by the value of its column `name`."""
    table = _table(path, {name: kind, **dict.fromkeys(columns, "float")})
    return dict(zip(table[name].tolist(), np.stack([table[each] for each in columns], axis=1), strict=True))


def _row(path: Path, name: str, rows: dict[Any, np.ndarray], key: int | str) -> np.ndarray:
    if key not in rows:
        raise FrameError(path, f"has no row for {name} (it has {first_few([*map(str, rows)], MOST_NAMED)})", REMEDY)
    return rows[key]


def _rigid(path: Path, name: str, rows: dict[Any, np.ndarray], key: int | str) -> RigidTransform:
    row = _row(path, name, rows, key)
    if not (are_plausible(row) and 0.5 < np.linalg.norm(row[:4]) < 2.0):
        raise FrameError(path, f"the pose of {name} is not a unit quaternion and a position", REMEDY)
    return RigidTransform.from_components(row[4:], Rotation.from_quat(row[:4], scalar_first=True))
