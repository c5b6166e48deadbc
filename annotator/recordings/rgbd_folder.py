"""The Open3D RGB-D folder: colour images, registered 16-bit depth images and one pinhole camera.

color/KEY.jpg|png   (or image/, if a camera file is in the folder itself)
depth/KEY.png       uint16, millimetres, or `depth_scale` units per metre
camera_intrinsic.json
gravity.json        optional: {"up": [x, y, z]} in the camera frame
timestamps.csv      optional: capture time of each frame (`frame_times`)
mask/, boxes.json   optional labels; read by annotator.formats, not here
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from annotator.geometry.projection import unproject_depth
from annotator.recordings.frame_times import Times, read_times
from annotator.recordings.image_file import read_depth, read_rgb
from annotator.recordings.listing import IMAGE_SUFFIXES, frame_file, sorted_keys, stems
from annotator.recordings.recording import KeyedFrames, NotFound
from annotator.recordings.rgbd_camera import RgbdCamera, camera_file, depth_metres, read_camera, read_up
from annotator.types import Camera, Frame, PointCloud
from annotator.types.errors import FrameError

LOOKED_FOR = "folders color/ (or image/ and a camera_*.json) and depth/"


@dataclass(frozen=True, eq=False)
class RgbdFolder(KeyedFrames):
    """A `Recording` of an Open3D RGB-D folder.

    The frames are assumed to be in time order, as is the convention.

    Attributes:
        color: the folder of the colour images.
        times_ns: capture times from `timestamps.csv`; None without that file.
    """

    color: Path
    times_ns: Times | None = None
    format: ClassVar[str] = "rgbd_folder"
    is_sequence: ClassVar[bool] = True

    def frame(self, i: int) -> Frame:
        """Reads frame `i` with `depth_m`; its cloud has `rgb` and `pixel_index`.

        Raises:
            FrameError: a missing or broken file, different sizes, or no depth at all.
            IndexError: there is no such frame.
        """
        key = self.key(i)
        depth_folder = self.path / "depth"
        color_path = frame_file(self.color, key, IMAGE_SUFFIXES, f"{depth_folder.name}/{key}.png")
        depth_path = frame_file(depth_folder, key, (".png",), f"{self.color.name}/{color_path.name}")
        content = read_camera(camera_file(self.path))
        rgb = read_rgb(color_path)
        _check_size(color_path, rgb, content.camera, f"the camera in {content.path.name}")
        depth_m = _depth_m(depth_path, content)
        return Frame(
            key=key,
            index=i,
            camera=content.camera,
            rgb=rgb,
            cloud=_cloud(depth_path, content.camera, depth_m, rgb),
            depth_m=depth_m,
            up=read_up(self.path / "gravity.json"),
            timestamp_ns=None if self.times_ns is None else self.times_ns[i],
        )


def open_rgbd_folder(path: Path) -> RgbdFolder | NotFound:
    """Opens the RGB-D folder at `path`; `NotFound` if it is not one.

    `image/` is used as the colour folder only beside a camera file: SUN RGB-D's raw folders have the same layout, but
    a different encoding of depth.

    Raises:
        RecordingError: the folders exist but have no image, or `timestamps.csv` is invalid.
    """
    depth = path / "depth"
    color = path / "color"
    if not color.is_dir() and any(path.glob("camera_*.json")):
        color = path / "image"
    if not (color.is_dir() and depth.is_dir()):
        return NotFound(LOOKED_FOR)
    keys = stems(color, IMAGE_SUFFIXES) | stems(depth, (".png",))
    ordered = sorted_keys(path, keys, f"images in {color.name}/ and depth/")
    return RgbdFolder(path, ordered, color, read_times(path, ordered))


def _depth_m(path: Path, content: RgbdCamera) -> np.ndarray:
    raw = read_depth(path)
    _check_size(path, raw, content.camera, "the colour image")
    return depth_metres(path, raw, content)


def _cloud(path: Path, camera: Camera, depth_m: np.ndarray, rgb: np.ndarray) -> PointCloud:
    xyz_m, pixel_index = unproject_depth(camera, depth_m)
    if len(xyz_m) == 0:
        raise FrameError(path, "no pixel has a depth, so the cloud is empty", "record the frame again, or remove it")
    return PointCloud(xyz_m, rgb=rgb.reshape(-1, 3).take(pixel_index, axis=0), pixel_index=pixel_index)


def _check_size(path: Path, image: np.ndarray, camera: Camera, other: str) -> None:
    height, width = image.shape[:2]
    if (width, height) != (camera.width_px, camera.height_px):
        raise FrameError(
            path,
            f"the image is {width} x {height} pixels, but {other} has {camera.width_px} x {camera.height_px}",
            "make images, registered depth and camera the same size",
        )
