"""Folders of point clouds: PLY, PCD, BIN, NPY, NPZ, LAS or LAZ, one file per frame.

KEY.ply (and so on)        in the folder itself, or in points/ (clouds/, pointcloud/, velodyne/, lidar/, pcd/, ply/)
image/KEY.png|jpg          optional (images/, image_2/, color/, rgb/): needs a calibration
calib/KEY.txt, calib.txt   optional: KITTI's calibration of a LiDAR and colour camera 2
labels/_classes.json       optional: a project of labelCloud, with labels/KEY.json [read by annotator.formats]
camera_intrinsic.json      optional alternative, as in an RGB-D folder; the clouds are in the camera's frame, or in the
                           frame that "cloud_to_camera" (4 x 4, row by row) maps to it
gravity.json               optional, beside camera_intrinsic.json
timestamps.csv             optional: capture time of each frame (`frame_times`)
poses.csv                  optional: poses of the clouds' frame (`poses`); poses.txt beside KITTI's calib.txt as in its
                           odometry. Clouds in map coordinates have their place without them

Without a calibration the clouds are assumed to come from a level LiDAR (x forward, y left, z up), with a virtual camera
at its origin, looking forward; in map coordinates, it stands where the points are (`origin`). Without images, the image
is rendered from the points.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import ClassVar, Never

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from annotator.frame_limits import memory_problem
from annotator.geometry.transforms import level_pose
from annotator.recordings.clouds.cloud_file import CLOUD_SUFFIXES, read_cloud
from annotator.recordings.clouds.columns import RawCloud
from annotator.recordings.clouds.virtual_camera import Origin, is_far, virtual_image, without_strays
from annotator.recordings.frame_times import Times, read_times
from annotator.recordings.image_file import ColorImage, read_color_image
from annotator.recordings.kitti import (
    ODOMETRY,
    UP,
    KittiCalibration,
    odometry_poses,
    read_calibration,
    visible_cloud,
)
from annotator.recordings.listing import IMAGE_SUFFIXES, file_errors, frame_file, require_size, sorted_keys, stems
from annotator.recordings.look_around import Scan, Scanned
from annotator.recordings.poses import FILE_NAME as POSES_CSV
from annotator.recordings.poses import Poses, read_poses
from annotator.recordings.recording import Place, ReaderOptions, option_flag
from annotator.recordings.rgbd_folder import FILE_NAME, read_camera, read_up
from annotator.recordings.scan_file import Scans
from annotator.text import normal, spelled
from annotator.types import Camera, Frame, PointCloud
from annotator.types.errors import ConfigError, FrameError

CLOUD_FOLDERS = ("points", "clouds", "cloud", "pointcloud", "pointclouds", "velodyne", "lidar", "pcd", "ply")
IMAGE_FOLDERS = ("image", "images", "image_2", "color", "rgb")
# For clouds without a camera; horizontal field of view 90 degrees.
VIRTUAL_CAMERA = Camera(1280, 720, 640.0, 640.0, 639.5, 359.5)
# Rows: the camera's x (right), y (down) and z (forward) in a LiDAR's x forward, y left, z up.
T_CAMERA_LIDAR = RigidTransform.from_matrix(np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]))
# In labelCloud's projects, z of the clouds points up.
LEVEL_MARK = "labels/_classes.json"


@dataclass(frozen=True, eq=False)
class CloudCamera:
    """The camera of a folder's clouds.

    Attributes:
        T_camera_cloud: from the clouds' own frame to the camera.
        up: unit vector against gravity in the camera frame; None if unknown.
        in_world: True if the clouds' frame is that of a map.
        kitti: KITTI's calibration; its matrices are used unchanged, though orthonormal only to seven digits.
    """

    path: Path
    T_camera_cloud: RigidTransform
    camera: Camera
    up: Float64[np.ndarray, "3"] | None
    in_world: bool = False
    kitti: KittiCalibration | None = None

    def to_camera(self, raw: RawCloud) -> PointCloud:
        """Returns a cloud in the camera frame."""
        transform = self.T_camera_cloud.apply if self.kitti is None else self.kitti.to_camera
        xyz_m = transform(raw.xyz_m)
        return PointCloud(xyz_m.astype(np.float32), rgb=raw.rgb, reflectance=raw.reflectance)


@dataclass(frozen=True, eq=False)
class CloudFolder(Scanned):
    """A `Recording` of a folder of point clouds, in time order; labels are in the clouds' own frame.

    `times_ns` are the capture times in `timestamps.csv`; None without that file. `poses` are those of the clouds, or of
    the calibration's camera (KITTI's odometry).
    """

    clouds: Path
    images: Path | None
    times_ns: Times | None = None
    told: tuple[str, ...] = ()
    scans: Scans = field(default_factory=Scans)
    given_origin: Place | None = None
    poses: Poses | None = None
    format: ClassVar[str] = "cloud_folder"
    is_sequence: ClassVar[bool] = True

    @property
    def notes(self) -> tuple[str, ...]:
        return (*self.told, *self.scans.notes, *self._origin.notes)

    def files(self, i: int) -> tuple[Path, ...]:
        key = self.key(i)
        cloud = self._cloud_path(key)
        if self.images is None:
            return (cloud,)
        return cloud, frame_file(self.images, key, IMAGE_SUFFIXES, f"{self.clouds.name}/{cloud.name}")

    def frame(self, i: int) -> Frame:
        """Reads frame `i`. With an image, its cloud holds the points inside the image, else all points."""
        key = self.key(i)
        cloud_path, *images = self.files(i)
        if not images:
            source, read = self._source(key)
            raw = read()
            problem = memory_problem(pixels=source.camera.width_px * source.camera.height_px)
            if problem:
                raise FrameError(source.path, f"its camera's image is {problem}", "correct the calibration")
            cloud = source.to_camera(raw)
            image = ColorImage(virtual_image(source.camera, cloud))
        else:
            path = self.calibration(key) or self._raise_no_calibration(key)
            # KITTI's calibration does not say the size
            size = read_camera(path).size if path.name == FILE_NAME else None
            raw, image = self._raw(key), read_color_image(images[0], size)
            source = self._camera(path, image.rgb)
            remedy = f"check that {source.path} belongs to this cloud and maps its frame to the camera's"
            xyz_m = source.to_camera(raw).xyz_m
            cloud = visible_cloud(cloud_path, source.camera, xyz_m, raw, image.rgb, remedy)
        moment = {
            "timestamp_ns": self._time_ns(i),
            "T_world_camera": self._T_world_camera(i, source),
            "in_map": source.in_world,
        }
        return image.frame(key, i, source.camera, cloud, up=source.up, T_camera_label=source.T_camera_cloud, **moment)

    def scan(self, i: int) -> Scan:
        """Returns the whole cloud of frame `i`, ahead being where its camera looks."""
        source, read = self._source(self.key(i))
        T_world_camera = self._T_world_camera(i, source)
        return Scan(
            read,
            level_pose(source.up).rotation * source.T_camera_cloud.rotation,
            source.T_camera_cloud.inv().translation if source.in_world else np.zeros(3),
            RigidTransform.identity(),
            source.up is not None,
            self._time_ns(i),
            None if T_world_camera is None else T_world_camera * source.T_camera_cloud,
            source.in_world,
        )

    @property
    def pose_source(self) -> str | None:
        return None if self.poses is None else self.poses.source

    def pose(self, i: int) -> RigidTransform | None:
        if self.poses is not None and self.calibration(self.key(i)) is None and not self._origin.xyz_m.any():
            # the virtual camera stands at the sensor, whatever this cloud has
            return self._T_world_camera(i, CloudCamera(self.path, T_CAMERA_LIDAR, VIRTUAL_CAMERA, UP, False))
        return self._T_world_camera(i, self._source(self.key(i))[0])

    def _T_world_camera(self, i: int, source: CloudCamera) -> RigidTransform | None:
        if source.in_world:
            return source.T_camera_cloud.inv()
        T = None if self.poses is None else self.poses.at(i, self._time_ns(i))
        if T is None or self.poses is None:
            return None
        return T * source.T_camera_cloud.inv() if self.poses.source == POSES_CSV else T

    def _time_ns(self, i: int) -> int | None:
        return None if self.times_ns is None else self.times_ns[i]

    @property
    def origin(self) -> Place | None:
        if self.calibration(self.keys[0]) is not None or not self._origin.xyz_m.any():
            return None
        return tuple(self._origin.xyz_m.tolist())

    @cached_property
    def _origin(self) -> Origin:
        return Origin(self.given_origin, lambda: (partial(self._raw, key) for key in self.keys))

    def _cloud_path(self, key: str) -> Path:
        return frame_file(self.clouds, key, CLOUD_SUFFIXES, "the other clouds")

    def _raw(self, key: str) -> RawCloud:
        return read_cloud(self._cloud_path(key), self.scans)

    def _source(self, key: str) -> tuple[CloudCamera, Callable[[], RawCloud]]:
        """Returns the camera of a frame without an image, and what reads its points.

        The camera is that of the calibration, else a virtual one, whose place follows from the points.
        """
        if (path := self.calibration(key)) is not None:
            return self._camera(path), lambda: self._raw(key)
        raw = self._raw(key)
        place_m = self._origin.of(raw)
        T = T_CAMERA_LIDAR * RigidTransform.from_translation(-place_m)
        camera = CloudCamera(self.path, T, VIRTUAL_CAMERA, UP, in_world=bool(place_m.any()))
        return camera, lambda: without_strays(raw, place_m)

    def calibration(self, key: str) -> Path | None:
        """Returns the file of a frame's calibration, KITTI's or annotator's; None without one."""
        files = (spelled(self.path / "calib", f"{key}.txt"), self.path / "calib.txt", self.path / FILE_NAME)
        return next((path for path in files if path.is_file()), None)

    def _camera(self, path: Path, rgb: np.ndarray | None = None) -> CloudCamera:
        """Returns the camera of a calibration file; without an image, KITTI's principal point is that of its middle."""
        kitti = None
        if path.name == FILE_NAME:
            read = read_camera(path)
            if rgb is not None:
                require_size(path, rgb, read.size, "the camera is for", "write the intrinsics for it")
            T, camera, up = read.T_camera_cloud, read.camera, read_up(path.with_name("gravity.json"))
        else:
            kitti = read_calibration(path)
            size = (2 * kitti.matrix[:2, 2] + 1).astype(int).tolist() if rgb is None else rgb.shape[1::-1]
            with file_errors(path, "correct the calibration"):
                camera = kitti.camera(*size)
            T = kitti.T_camera_lidar
            up = T.rotation.apply([0.0, 0.0, 1.0]) if (self.path / LEVEL_MARK).is_file() else UP
        return CloudCamera(path, T, camera, up, is_far(T.inv().translation), kitti)

    def _raise_no_calibration(self, key: str) -> Never:
        raise FrameError(
            self.path / FILE_NAME,
            "the calibration of the images is missing",
            f"write {FILE_NAME} (with cloud_to_camera), or add KITTI's calib/{key}.txt or calib.txt, or remove the "
            "images from the folder",
        )


def _poses(folder: CloudFolder, calibration: Path | None) -> Poses | None:
    """Returns the poses of poses.csv, or of the odometry's poses.txt beside a calibration of KITTI."""
    odometry = folder.path / ODOMETRY
    if calibration is not None and calibration.name != FILE_NAME and odometry.is_file():
        with suppress(FrameError):  # of the calibration, which each frame reports
            return odometry_poses(odometry, read_calibration(calibration), folder.keys)
    return read_poses(folder.path, folder.keys, folder.times_ns)


def open_cloud_folder(path: Path, options: ReaderOptions) -> CloudFolder | None:
    """Opens the folder of point clouds at `path`; None if it is not one."""
    if not path.is_dir():
        return None
    for clouds in (path, *(path / name for name in CLOUD_FOLDERS)):
        keys = stems(clouds, CLOUD_SUFFIXES) if clouds.is_dir() else set()
        if keys:
            images = next((path / name for name in IMAGE_FOLDERS if (path / name).is_dir()), None)
            if images is None and {*map(normal, keys)} & {*map(normal, stems(clouds, IMAGE_SUFFIXES))}:
                images = clouds
            ordered = sorted_keys(path, keys, "files of points")
            times = read_times(path, ordered)
            folder = CloudFolder(path, ordered, clouds, images, *times, Scans(options.columns), options.origin)
            calibration = folder.calibration(ordered[0])
            folder = replace(folder, poses=_poses(folder, calibration))
            if options.origin is not None and calibration is not None:
                raise ConfigError(
                    f"{path}: {calibration.name} says where the camera is, so {option_flag('origin')} is not taken; "
                    "leave out one of them"
                )
            return folder
    return None
