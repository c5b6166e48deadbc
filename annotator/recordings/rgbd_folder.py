"""The Open3D RGB-D folder: colour images, 16-bit depth images and a pinhole camera.

color/KEY.jpg|png   (or rgb/, or image/ if a camera file is in the folder itself)
depth/KEY.png       uint16, millimetres, or `depth_scale` units per metre; registered to the colour images, or
camera_intrinsic.json
depth_intrinsic.json   of another camera; optional
gravity.json        optional: {"up": [x, y, z]} in the camera frame
timestamps.csv      optional: capture time of each frame (`frame_times`)
poses.csv, or a trajectory of Open3D   optional: poses of the colour camera (`poses`)
mask/, boxes.json   optional labels; read by annotator.formats, not here
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from jaxtyping import Float32, Float64, UInt8, UInt16
from pydantic import Field, FiniteFloat
from scipy.spatial.transform import RigidTransform

from annotator.files import open_file, read_text_file
from annotator.geometry.projection import in_metres, pixel_colors, resized, unproject_depth
from annotator.image_bytes import declared_size
from annotator.recordings.frame_times import Times, read_times
from annotator.recordings.image_file import ColorImage, decode_depth, looks_rotated, read_color_image, read_depth
from annotator.recordings.listing import (
    IMAGE_SUFFIXES,
    file_errors,
    frame_file,
    joined,
    require_size,
    sorted_keys,
    stems,
)
from annotator.recordings.plausible import LARGEST, LARGEST_SIDE_PX, is_pinhole, is_rotation, pinhole
from annotator.recordings.poses import Poses, read_open3d, read_poses
from annotator.recordings.recording import Recording
from annotator.recordings.two_cameras import registered
from annotator.types import Camera, Frame, PointCloud
from annotator.types.bases import FileRecord, Strict
from annotator.types.errors import FrameError, UnclearError

FILE_NAME, DEPTH_FILE_NAME = "camera_intrinsic.json", "depth_intrinsic.json"
MM_PER_M = 1000.0
MOST_OFF_ROTATION = 1e-3
IDENTITY = RigidTransform.identity()
Side = Annotated[int, Field(gt=0, le=LARGEST_SIDE_PX)]
Number = Annotated[FiniteFloat, Field(ge=-LARGEST, le=LARGEST)]
Four = tuple[Number, Number, Number, Number]
Rows = Annotated[tuple[Four, ...], Field(min_length=4, max_length=4)]
Positive = Annotated[FiniteFloat, Field(ge=1 / LARGEST, le=LARGEST)]


class IntrinsicFile(FileRecord):
    """`camera_intrinsic.json`, `depth_intrinsic.json`: Open3D's PinholeCameraIntrinsic, with optional keys.

    Attributes:
        width, height: image size, pixels.
        intrinsic_matrix: the nine numbers of K, column by column.
        depth_scale: depth units per metre; default that of the format, 1000 (millimetres) for most.
        depth_encoding: `plain`, or `sunrgbd` for SUN RGB-D's rotated bits; default plain, unless it looks rotated.
        distortion: OpenCV's coefficients, see `Camera`; default none.
        depth_to_color, cloud_to_camera: transforms from the frame of the depth camera, or of the clouds, to that of the
            colour camera, metres, row by row; default none: the frames are the same.
    """

    width: Side
    height: Side
    intrinsic_matrix: Annotated[tuple[Number, ...], Field(min_length=9, max_length=9)]
    depth_scale: Positive | None = None
    depth_encoding: Literal["plain", "sunrgbd"] | None = None
    distortion: tuple[Number, ...] = ()
    depth_to_color: Rows | None = None
    cloud_to_camera: Rows | None = None


class GravityFile(Strict):
    """`gravity.json`: the direction against gravity in the camera frame, any length but 0."""

    up: tuple[Number, Number, Number]


@dataclass(frozen=True, eq=False)
class RgbdCamera:
    """A camera file's content.

    Attributes:
        depth_scale: depth units per metre.
        T_color_depth, T_camera_cloud: from the frame of the depth camera, or of the clouds, to the colour camera's.
    """

    path: Path
    camera: Camera
    depth_scale: float
    depth_encoding: Literal["plain", "sunrgbd"] | None = None
    T_color_depth: RigidTransform = IDENTITY
    T_camera_cloud: RigidTransform = IDENTITY

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of its images, pixels."""
        return self.camera.width_px, self.camera.height_px


def camera_file(folder: Path) -> Path:
    """Returns the camera file of a folder: `camera_intrinsic.json`, else the only `camera_*.json` with a matrix.

    The latter is looked up in the folder and then, for several recordings of one camera, one level above.
    """
    expected = folder / FILE_NAME
    if expected.is_file():
        return expected
    found: list[Path] = []
    for place in (folder, folder.resolve().parent):
        found = found or [path for path in sorted(place.glob("camera_*.json")) if _has_matrix(path)]
    if len(found) == 1:
        return found[0]
    names = ", ".join(path.name for path in found)
    raise FrameError(
        expected,
        f"missing, and {found[0].parent} has several cameras ({names})" if found else "missing",
        f"copy the right one to {FILE_NAME}"
        if found
        else "write width, height and intrinsic_matrix (column-major) of the colour camera",
    )


def _has_matrix(path: Path) -> bool:
    with file_errors(path, "correct or remove it"):
        text = read_text_file(path) if path.is_file() else ""
        # a trajectory has a camera for each pose
        return '"intrinsic_matrix"' in text and '"extrinsic"' not in text


def read_camera(path: Path, depth_scale: float = MM_PER_M) -> RgbdCamera:
    """Reads a camera file; `depth_scale` is used if it has none."""
    with file_errors(path, "compare it with Open3D's format", "not a camera file: "):
        content = IntrinsicFile.model_validate_json(read_text_file(path))
    K = np.array(content.intrinsic_matrix).reshape(3, 3).T
    if not is_pinhole(K):
        raise FrameError(
            path,
            "intrinsic_matrix is not fx 0 0 0 fy 0 cx cy 1, or a focal length is implausible",
            "write it column by column",
        )
    with file_errors(path, "correct the camera file"):
        camera = pinhole(K, content.width, content.height, content.distortion)
    scale = depth_scale if content.depth_scale is None else content.depth_scale
    poses = (_rigid(path, name, getattr(content, name)) for name in ("depth_to_color", "cloud_to_camera"))
    return RgbdCamera(path, camera, scale, content.depth_encoding, *poses)


def depth_metres(path: Path, raw: UInt16[np.ndarray, "h w"], camera: RgbdCamera) -> Float32[np.ndarray, "h w"]:
    if camera.depth_encoding == "sunrgbd":
        return decode_depth(raw)
    if camera.depth_encoding is None and looks_rotated(raw, camera.depth_scale):
        raise UnclearError(
            path,
            f"its depth reaches {raw.max() / camera.depth_scale:.1f} m in steps of 8 units, as in SUN RGB-D, whose "
            "depth has its bits rotated by three",
            f'write "depth_encoding": "sunrgbd" (or "plain" to read it as it is) into {camera.path.name}',
        )
    return in_metres(raw, camera.depth_scale)


def read_depth_camera(folder: Path, color: RgbdCamera, image: Path, size: tuple[int, int]) -> RgbdCamera | None:
    """Returns the camera of a depth image of `size` (width, height); None if it is registered to the colour camera.

    Without `depth_intrinsic.json`, depth images of another size but the same proportions are taken to show the same
    part of the scene, as a phone's do.
    """
    path = folder / DEPTH_FILE_NAME
    if not path.is_file():
        if size == color.size:
            return None
        if size[0] * color.size[1] != size[1] * color.size[0]:
            raise FrameError(
                image,
                f"the image is {size[0]} x {size[1]} pixels, but the colour image has "
                f"{color.size[0]} x {color.size[1]}",
                f"make them the same size, or describe the depth camera in {DEPTH_FILE_NAME} (width, height, "
                "intrinsic_matrix, depth_to_color)",
            )
        return replace(color, camera=resized(color.camera, *size))
    return read_camera(path, color.depth_scale)


def _rigid(path: Path, name: str, rows: tuple[Four, ...] | None) -> RigidTransform:
    """Returns the transform with these rows, the identity for None; `name` is the key in the file."""
    if rows is None:
        return IDENTITY
    matrix = np.array(rows)
    if not is_rotation(matrix[:3, :3], MOST_OFF_ROTATION) or tuple(matrix[3]) != (0, 0, 0, 1):
        raise FrameError(path, f"{name} is not a rigid transform (last row 0 0 0 1)", "write it row by row")
    return RigidTransform.from_matrix(matrix)


def read_up(path: Path) -> Float64[np.ndarray, "3"] | None:
    """Returns the unit vector against gravity; None if there is no such file."""
    if not path.exists():
        return None
    with file_errors(path, 'write {"up": [x, y, z]}', "not a gravity file: "):
        up = GravityFile.model_validate_json(read_text_file(path)).up
    return unit_up(path, up, "write the direction against gravity in the camera frame")


def unit_up(path: Path, up: tuple[float, ...], remedy: str) -> Float64[np.ndarray, "3"]:
    length = np.linalg.norm(up)
    if length < 1 / LARGEST:
        raise FrameError(path, "up has length 0", remedy)
    return np.array(up) / length


# What is before the pixels of a depth image.
PNG_HEAD_BYTES = 4096


@dataclass(frozen=True, eq=False)
class RgbdFolder(Recording):
    """A `Recording` of an Open3D RGB-D folder.

    The frames are assumed to be in time order, as is the convention. `times_ns` are the capture times in
    `timestamps.csv`; None without that file.
    """

    color: Path
    times_ns: Times | None = None
    told: tuple[str, ...] = ()
    poses: Poses | None = None
    format: ClassVar[str] = "rgbd_folder"
    is_sequence: ClassVar[bool] = True
    is_parallel: ClassVar[bool] = True

    def files(self, i: int) -> tuple[Path, Path]:
        key = self.key(i)
        color = frame_file(self.color, key, IMAGE_SUFFIXES, f"depth/{key}.png")
        return color, frame_file(self.path / "depth", key, (".png",), f"{self.color.name}/{color.name}")

    def image(self, i: int) -> UInt8[np.ndarray, "h w 3"]:
        return read_color_image(self.files(i)[0], read_camera(camera_file(self.path)).size, has_depth=True).rgb

    def frame(self, i: int) -> Frame:
        """Reads frame `i` with `depth_m`; its cloud has `rgb`, and `pixel_index` if the depth is registered."""
        key, (color_path, depth_path) = self.key(i), self.files(i)
        color = read_camera(camera_file(self.path))
        image, cloud, depth_m = read_images(self.path, color_path, depth_path, color)
        moment = {"timestamp_ns": self._time_ns(i), "T_world_camera": self.pose(i)}
        up = read_up(self.path / "gravity.json")
        return image.frame(key, i, color.camera, cloud, depth_m=depth_m, up=up, **moment)

    @property
    def pose_source(self) -> str | None:
        return None if self.poses is None else self.poses.source

    def pose(self, i: int) -> RigidTransform | None:
        self.key(i)
        return None if self.poses is None else self.poses.at(i, self._time_ns(i))

    def _time_ns(self, i: int) -> int | None:
        return None if self.times_ns is None else self.times_ns[i]

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


def open_rgbd_folder(path: Path) -> RgbdFolder | None:
    """Opens the RGB-D folder at `path`; None if it is not one.

    `image/` is used as the colour folder only beside a camera file: SUN RGB-D's raw folders have the same layout, but
    a different encoding of depth.
    """
    depth = path / "depth"
    color = next((path / name for name in ("color", "rgb") if (path / name).is_dir()), path / "color")
    if not color.is_dir() and any(path.glob("camera_*.json")):
        color = path / "image"
    if not (color.is_dir() and depth.is_dir()):
        return None
    keys = joined(stems(color, IMAGE_SUFFIXES), stems(depth, (".png",)))
    ordered = sorted_keys(path, keys, f"images in {color.name}/ and depth/")
    times_ns, told = read_times(path, ordered)
    poses, more = read_poses(path, ordered, times_ns), tuple[str, ...]()
    if poses is None:
        poses, more = read_open3d(path, len(ordered))
    return RgbdFolder(path, ordered, color, times_ns, (*told, *more), poses)


def read_images(
    folder: Path, color_path: Path, depth_path: Path, color: RgbdCamera
) -> tuple[ColorImage, PointCloud, Float32[np.ndarray, "h w"]]:
    """Reads a colour and a depth image of a folder.

    Returns the colour image; the depth image's cloud, with `pixel_index` if it is registered; and the depth in the
    colour image's pixels, metres.
    """
    image = read_color_image(color_path, color.size, has_depth=True)
    rgb = image.rgb
    require_size(color_path, rgb, color.size, f"the camera in {color.path.name} has", "make them the same size")
    raw = read_depth(depth_path)
    depth = read_depth_camera(folder, color, depth_path, (raw.shape[1], raw.shape[0]))
    if depth is None:
        depth_m = depth_metres(depth_path, raw, color)
        xyz_m, pixel = unproject_depth(color.camera, depth_m)
        cloud = PointCloud(xyz_m, rgb=pixel_colors(rgb, pixel), pixel_index=pixel)
        problem = "no pixel has a depth, so the cloud is empty"
    else:
        require_size(depth_path, raw, depth.size, f"the camera in {depth.path.name} has", "correct the file")
        cloud, depth_m = registered(
            depth_metres(depth_path, raw, depth), depth.camera, depth.T_color_depth, rgb, color.camera
        )
        problem = f"no pixel with a depth lies in the colour image, so the cloud is empty (by {depth.path.name})"
    if len(cloud) == 0:
        raise FrameError(depth_path, problem, "record the frame again, or remove it")
    return image, cloud, depth_m
