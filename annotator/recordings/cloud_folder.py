"""Folders of point clouds: PLY, PCD, KITTI's BIN, NPY, NPZ, LAS or LAZ, a file a frame.

KEY.ply (and so on)        in the folder itself, or in points/ (clouds/, pointcloud/, velodyne/, lidar/, pcd/, ply/)
image/KEY.png|jpg          optional (images/, image_2/, color/, rgb/): needs a calibration
calib/KEY.txt, calib.txt   optional: KITTI's calibration of a LiDAR and colour camera 2
camera_intrinsic.json      optional instead: as of an RGB-D folder, the clouds are in the camera's frame; or in another,
                           from which "cloud_to_camera" (4 x 4, row by row) leads to it
gravity.json               optional, beside camera_intrinsic.json
timestamps.csv             optional: when each frame was taken (`frame_times`)

Without a calibration the clouds are taken for a level LiDAR's (x forward, y left, z up), and a camera is put at its
place, looking forward; where all points are further away than a LiDAR sees, those of a map, it is put among them.
Without images the picture is drawn from the points.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Never

import numpy as np
from jaxtyping import Float64
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from scipy.spatial.transform import RigidTransform

from annotator.geometry.projection import inside_image, project
from annotator.pictures import MOST_PIXELS
from annotator.recordings.cloud_columns import RawCloud
from annotator.recordings.cloud_file import CLOUD_SUFFIXES, read_cloud
from annotator.recordings.frame_times import Times, read_times
from annotator.recordings.image_file import read_rgb
from annotator.recordings.kitti_calib import KittiCalibration, read_calibration
from annotator.recordings.kitti_frame import NEAREST_Z_M, UP
from annotator.recordings.listing import IMAGE_SUFFIXES, frame_file, sorted_keys, stems
from annotator.recordings.plausible import is_rotation
from annotator.recordings.recording import KeyedFrames, NotFound
from annotator.recordings.rgbd_camera import FILE_NAME, Number, read_camera, read_up
from annotator.recordings.virtual_image import virtual_image
from annotator.types import Camera, Frame, PointCloud
from annotator.types.errors import FrameError

LOOKED_FOR = f"files of points ({' '.join(CLOUD_SUFFIXES)}), here or in points/"
CLOUD_FOLDERS = ("points", "clouds", "cloud", "pointcloud", "pointclouds", "velodyne", "lidar", "pcd", "ply")
IMAGE_FOLDERS = ("image", "images", "image_2", "color", "rgb")
# A picture of 90 degrees, for clouds without a camera.
VIRTUAL_CAMERA = Camera(1280, 720, 640.0, 640.0, 639.5, 359.5)
# Rows: the camera's x (right), y (down) and z (forward) in a LiDAR's x forward, y left, z up.
T_CAMERA_LIDAR = RigidTransform.from_matrix(np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]))
MOST_OFF_ROTATION = 1e-3
# Coordinates that begin further away are those of a map.
FARTHEST_SEEN_M = 10_000.0
Four = tuple[Number, Number, Number, Number]


class CloudPoseFile(BaseModel):
    """What `camera_intrinsic.json` may say of the clouds' own frame."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    cloud_to_camera: Annotated[tuple[Four, ...], Field(min_length=4, max_length=4)] | None = None


@dataclass(frozen=True, eq=False)
class View:
    """From where the clouds of a folder are seen.

    Attributes:
        path: the file that says so, for messages.
        T_camera_cloud: from the clouds' own frame.
        up: against gravity in the camera frame, where it is known.
        kitti: KITTI's calibration, whose matrices are followed to the letter: they are rotations to seven digits only.
    """

    path: Path
    T_camera_cloud: RigidTransform
    camera: Camera
    up: Float64[np.ndarray, "3"] | None
    kitti: KittiCalibration | None = None

    def see(self, raw: RawCloud) -> PointCloud:
        """A cloud in the camera frame."""
        to_camera = self.T_camera_cloud.apply if self.kitti is None else self.kitti.to_camera
        xyz_m = to_camera(raw.xyz_m)
        return PointCloud(xyz_m.astype(np.float32), rgb=raw.rgb, reflectance=raw.reflectance)


@dataclass(frozen=True, eq=False)
class CloudFolder(KeyedFrames):
    """A `Recording` of a folder of point clouds, taken to be in time order; labels are in the clouds' own frame.

    Attributes:
        clouds: where the files of points are.
        images: where the images are, or None without any.
        times_ns: when each frame was taken, where `timestamps.csv` says so.
    """

    clouds: Path
    images: Path | None
    times_ns: Times | None = None
    format: ClassVar[str] = "cloud_folder"
    is_sequence: ClassVar[bool] = True

    def frame(self, i: int) -> Frame:
        """Frame `i`. With an image, its cloud is what the image shows; otherwise all points, also those behind.

        Raises:
            FrameError: a missing or broken file, an image without a calibration, or no point in it.
            IndexError: there is no such frame.
        """
        key = self.key(i)
        cloud_path = frame_file(self.clouds, key, CLOUD_SUFFIXES, "the other clouds")
        raw = read_cloud(cloud_path)
        if self.images is None:
            view = self._view(key, None) or _level_view(self.path, raw)
            if view.camera.width_px * view.camera.height_px > MOST_PIXELS:
                size = f"{view.camera.width_px} x {view.camera.height_px}"
                raise FrameError(view.path, f"is of a camera with {size} pixels", "correct the calibration")
            cloud = view.see(raw)
            rgb = virtual_image(view.camera, cloud)
        else:
            image_path = frame_file(self.images, key, IMAGE_SUFFIXES, f"{self.clouds.name}/{cloud_path.name}")
            rgb = read_rgb(image_path)
            view = self._view(key, rgb) or self._refuse(key)
            cloud = _seen(view, view.see(raw), rgb)
            if len(cloud) == 0:
                raise FrameError(
                    cloud_path,
                    f"none of its {len(raw.xyz_m)} points lies in the image, the cloud is empty",
                    f"check that {view.path} belongs to this cloud, and leads from its frame to the camera's",
                )
        return Frame(
            key,
            i,
            view.camera,
            rgb,
            cloud,
            up=view.up,
            T_camera_label=view.T_camera_cloud,
            timestamp_ns=None if self.times_ns is None else self.times_ns[i],
        )

    def _view(self, key: str, rgb: np.ndarray | None) -> View | None:
        """As the folder's calibration has it; None without one."""
        for path in (self.path / "calib" / f"{key}.txt", self.path / "calib.txt"):
            if path.is_file():
                return _kitti_view(path, rgb)
        path = self.path / FILE_NAME
        return _json_view(path, rgb) if path.is_file() else None

    def _refuse(self, key: str) -> Never:
        raise FrameError(
            self.path / FILE_NAME,
            "the calibration of the images is missing",
            f"write {FILE_NAME} (with cloud_to_camera), or put KITTI's calib/{key}.txt or calib.txt there, or take the "
            "images out of the folder",
        )


def open_cloud_folder(path: Path) -> CloudFolder | NotFound:
    """The folder of point clouds at `path`, where it is one.

    Raises:
        RecordingError: the times cannot be used.
    """
    if not path.is_dir():
        return NotFound(LOOKED_FOR)
    for clouds in (path, *(path / name for name in CLOUD_FOLDERS)):
        keys = stems(clouds, CLOUD_SUFFIXES) if clouds.is_dir() else set()
        if keys:
            images = next((path / name for name in IMAGE_FOLDERS if (path / name).is_dir()), None)
            if images is None and keys & stems(clouds, IMAGE_SUFFIXES):
                images = clouds
            ordered = sorted_keys(path, keys, LOOKED_FOR)
            return CloudFolder(path, ordered, clouds, images, read_times(path, ordered))
    return NotFound(LOOKED_FOR)


def _level_view(path: Path, raw: RawCloud) -> View:
    """A level LiDAR's, from its own place; or from the middle of a cloud that lies on a map, in whole metres."""
    nearest_m = np.sqrt((raw.xyz_m**2).sum(axis=1).min())
    place_m = np.floor(np.median(raw.xyz_m, axis=0)) if nearest_m > FARTHEST_SEEN_M else np.zeros(3)
    return View(path, T_CAMERA_LIDAR * RigidTransform.from_translation(-place_m), VIRTUAL_CAMERA, UP)


def _kitti_view(path: Path, rgb: np.ndarray | None) -> View:
    """Colour camera 2; without an image its principal point is taken for the middle."""
    calibration = read_calibration(path)
    if rgb is not None:
        camera = calibration.camera(rgb.shape[1], rgb.shape[0])
    else:
        width, height = (int(2 * calibration.matrix[axis, 2]) + 1 for axis in (0, 1))
        if min(width, height) <= 0:
            raise FrameError(path, f"P2 is of an image of {width} x {height} pixels", "correct the calibration")
        camera = calibration.camera(width, height)
    return View(path, calibration.T_camera_lidar, camera, UP, calibration)


def _json_view(path: Path, rgb: np.ndarray | None) -> View:
    camera = read_camera(path).camera
    if rgb is not None and rgb.shape[:2] != (camera.height_px, camera.width_px):
        raise FrameError(
            path,
            f"is for images of {camera.width_px} x {camera.height_px} pixels, "
            f"this one has {rgb.shape[1]} x {rgb.shape[0]}",
            "write the camera of these images",
        )
    try:
        rows = CloudPoseFile.model_validate_json(path.read_bytes()).cloud_to_camera
    except (OSError, ValidationError) as error:
        raise FrameError(path, "cloud_to_camera is not four rows of four numbers", "correct the camera file") from error
    return View(path, _pose(path, rows), camera, read_up(path.with_name("gravity.json")))


def _pose(path: Path, rows: tuple[Four, ...] | None) -> RigidTransform:
    if rows is None:
        return RigidTransform.identity()
    matrix = np.array(rows)
    if not is_rotation(matrix[:3, :3], MOST_OFF_ROTATION) or tuple(matrix[3]) != (0, 0, 0, 1):
        raise FrameError(path, "cloud_to_camera is not a rotation and a shift above 0 0 0 1", "write it row by row")
    return RigidTransform.from_matrix(matrix)


def _seen(view: View, cloud: PointCloud, rgb: np.ndarray) -> PointCloud:
    """The points that project inside the image; those without colours of their own get their pixel's."""
    camera = view.camera
    px = project(camera, cloud.xyz_m)
    kept = np.flatnonzero(inside_image(camera, px) & (cloud.xyz_m[:, 2] > NEAREST_Z_M))
    seen = cloud.select(kept)
    if seen.rgb is not None:
        return seen
    u, v = np.floor(px[kept] + 0.5).astype(np.int64).T
    return PointCloud(seen.xyz_m, rgb=rgb[v, u], reflectance=seen.reflectance)
