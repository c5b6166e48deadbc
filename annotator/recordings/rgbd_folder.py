"""The Open3D RGB-D folder: colour images, 16-bit depth images and a pinhole camera.

color/KEY.jpg|png   (or rgb/, or image/ if a camera file is in the folder itself)
depth/KEY.png       uint16, millimetres, or `depth_scale` units per metre; registered to the colour images, or
camera_intrinsic.json
depth_intrinsic.json   of another camera; optional
gravity.json        optional: {"up": [x, y, z]} in the camera frame
timestamps.csv      optional: capture time of each frame (`frame_times`)
mask/, boxes.json   optional labels; read by annotator.formats, not here
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Float32

from annotator.files import open_file
from annotator.geometry.projection import pixel_colors, unproject_depth
from annotator.image_bytes import declared_size
from annotator.recordings.frame_times import Times, read_times
from annotator.recordings.image_file import ColorImage, read_color_image, read_depth
from annotator.recordings.listing import IMAGE_SUFFIXES, frame_file, joined, sorted_keys, stems
from annotator.recordings.recording import KeyedFrames, NotFound
from annotator.recordings.rgbd_camera import (
    RgbdCamera,
    camera_file,
    depth_metres,
    read_camera,
    read_depth_camera,
    read_up,
)
from annotator.recordings.two_cameras import registered
from annotator.types import Frame, PointCloud
from annotator.types.errors import FrameError

LOOKED_FOR = "folders color/ or rgb/ (or image/ and a camera_*.json) and depth/"

# A PNG file's signature and first chunk.
PNG_HEAD_BYTES = 33


@dataclass(frozen=True, eq=False)
class RgbdFolder(KeyedFrames):
    """A `Recording` of an Open3D RGB-D folder.

    The frames are assumed to be in time order, as is the convention.

    Attributes:
        color: the folder of the colour images.
        times_ns: capture times from `timestamps.csv`; None without that file.
        told: what was found in that file.
    """

    color: Path
    times_ns: Times | None = None
    told: tuple[str, ...] = ()
    format: ClassVar[str] = "rgbd_folder"
    is_sequence: ClassVar[bool] = True
    is_parallel: ClassVar[bool] = True

    def files(self, i: int) -> tuple[Path, Path]:
        key = self.key(i)
        color = frame_file(self.color, key, IMAGE_SUFFIXES, f"depth/{key}.png")
        return color, frame_file(self.path / "depth", key, (".png",), f"{self.color.name}/{color.name}")

    def frame(self, i: int) -> Frame:
        """Reads frame `i` with `depth_m`; its cloud has `rgb`, and `pixel_index` if the depth is registered.

        Raises:
            FrameError: a missing or broken file, different sizes, or no depth in the image.
            IndexError: there is no such frame.
        """
        key, (color_path, depth_path) = self.key(i), self.files(i)
        color = read_camera(camera_file(self.path))
        image, cloud, depth_m = read_images(self.path, color_path, depth_path, color)
        return Frame(
            key=key,
            index=i,
            camera=color.camera,
            rgb=image.rgb,
            cloud=cloud,
            depth_m=depth_m,
            up=read_up(self.path / "gravity.json"),
            timestamp_ns=None if self.times_ns is None else self.times_ns[i],
            exif_orientation=image.exif_orientation,
        )

    @property
    def notes(self) -> tuple[str, ...]:
        try:
            color = read_camera(camera_file(self.path))
            first = next(file for key in self.keys if (file := self.path / "depth" / f"{key}.png").is_file())
            with open_file(first) as opened:
                size = declared_size(opened.read(PNG_HEAD_BYTES))
            depth = read_depth_camera(self.path, color, first, size) if all(size) else None
        except (OSError, FrameError, StopIteration):  # each frame reports it
            return self.told
        if depth is None or depth.path != color.path:
            return self.told
        return (
            *self.told,
            f"The depth images of {size[0]} x {size[1]} pixels are taken to show the same as the colour images of "
            f"{color.size[0]} x {color.size[1]}; if another camera took them, write depth_intrinsic.json.",
        )


def open_rgbd_folder(path: Path) -> RgbdFolder | NotFound:
    """Opens the RGB-D folder at `path`; `NotFound` if it is not one.

    `image/` is used as the colour folder only beside a camera file: SUN RGB-D's raw folders have the same layout, but
    a different encoding of depth.

    Raises:
        RecordingError: the folders exist but have no image, or `timestamps.csv` is invalid.
    """
    depth = path / "depth"
    color = next((path / name for name in ("color", "rgb") if (path / name).is_dir()), path / "color")
    if not color.is_dir() and any(path.glob("camera_*.json")):
        color = path / "image"
    if not (color.is_dir() and depth.is_dir()):
        return NotFound(LOOKED_FOR)
    keys = joined(stems(color, IMAGE_SUFFIXES), stems(depth, (".png",)))
    ordered = sorted_keys(path, keys, f"images in {color.name}/ and depth/")
    return RgbdFolder(path, ordered, color, *read_times(path, ordered))


def read_images(
    folder: Path, color_path: Path, depth_path: Path, color: RgbdCamera
) -> tuple[ColorImage, PointCloud, Float32[np.ndarray, "h w"]]:
    """Reads a colour and a depth image of a folder.

    Returns:
        The colour image; the depth image's cloud, with `pixel_index` if it is registered; and the depth in the colour
        image's pixels, metres.

    Raises:
        FrameError: a missing or broken file, different sizes, or no depth in the image.
    """
    image = read_color_image(color_path, color.size, has_depth=True)
    rgb = image.rgb
    _check_size(color_path, rgb, color, "make images and camera the same size")
    raw = read_depth(depth_path)
    depth = read_depth_camera(folder, color, depth_path, (raw.shape[1], raw.shape[0]))
    if depth is None or depth.T_color_depth is None:
        depth_m = depth_metres(depth_path, raw, color)
        xyz_m, pixel = unproject_depth(color.camera, depth_m)
        cloud = PointCloud(xyz_m, rgb=pixel_colors(rgb, pixel), pixel_index=pixel)
        problem = "no pixel has a depth, so the cloud is empty"
    else:
        _check_size(depth_path, raw, depth, "correct the file")
        cloud, depth_m = registered(
            depth_metres(depth_path, raw, depth), depth.camera, depth.T_color_depth, rgb, color.camera
        )
        problem = f"no pixel with a depth lies in the colour image, so the cloud is empty (by {depth.path.name})"
    if len(cloud) == 0:
        raise FrameError(depth_path, problem, "record the frame again, or remove it")
    return image, cloud, depth_m


def _check_size(path: Path, image: np.ndarray, camera: RgbdCamera, remedy: str) -> None:
    height, width = image.shape[:2]
    if (width, height) != camera.size:
        raise FrameError(
            path,
            f"the image is {width} x {height} pixels, but the camera in {camera.path.name} has "
            f"{camera.size[0]} x {camera.size[1]}",
            remedy,
        )
