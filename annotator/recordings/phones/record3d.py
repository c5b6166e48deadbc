"""Record3D (`.r3d`), an app for iPhones and iPads: a zip archive, or the folder with its content.

metadata          JSON: w h (image size), dw dh (depth size), K (column by column), poses, fps, ...
rgbd/N.jpg        the colour image
rgbd/N.depth      LZFSE: float32, metres, row by row, NaN without a measurement
rgbd/N.conf       LZFSE: uint8, confidence 0 to 2; optional

The format is described in issues of github.com/marek-simonik/record3d (7, 27, 33, 36). `poses` are qx qy qz qw x y z,
camera to world, with OpenGL's camera axes (x right, y up, z backward). Older versions of the app recorded them relative
to the first image, so that the direction of gravity is not known.

ARKit's depth image shows the same part of the scene as the colour image, with fewer pixels. Confidence is 0 (low), 1 or
2 (high). ARKit's world has y up (`ARConfiguration.WorldAlignment.gravity`).

LZFSE is Apple's compression. Its package (the extra `phones`) trusts what it reads, so it runs in the `fence`.
"""

from __future__ import annotations

import os
import re
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from pydantic import Field
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.fence import fenced
from annotator.files import ARCHIVE_ERRORS, check_file
from annotator.frame_limits import read_frame_file, require_memory, require_pixels
from annotator.geometry.projection import in_metres, resized
from annotator.image_bytes import decode_image
from annotator.recordings.frame_times import Times, known_times
from annotator.recordings.listing import file_errors, sorted_keys
from annotator.recordings.plausible import is_pinhole, pinhole
from annotator.recordings.recording import ReaderOptions, Recording
from annotator.recordings.rgbd_folder import Number, Positive, Side
from annotator.recordings.two_cameras import registered
from annotator.types import Camera, Frame, PointCloud
from annotator.types.bases import FileRecord
from annotator.types.checks import LATEST_NS
from annotator.types.errors import FrameError, MissingExtraError, RecordingError

# The lowest confidence that is used, unless the option `min_confidence` says otherwise. Low confidence is found at
# edges, where values lie between object and background, and on dark or shiny surfaces.
MIN_CONFIDENCE = 1
MOST_OFF_UNIT = 1e-3
# Part of the up direction that must lie in the image plane to tell which way an image is held.
LEAST_UPRIGHT = 0.3


def phone_cloud(
    path: Path,
    camera: Camera,
    rgb: UInt8[np.ndarray, "H W 3"],
    depth_m: Float32[np.ndarray, "h w"],
    confidence: UInt8[np.ndarray, "h w"] | None,
    min_confidence: int | None,
) -> tuple[PointCloud, Float32[np.ndarray, "H W"]]:
    """Returns the coloured points of a phone's depth image, and the depth in the colour image's pixels.

    Args:
        camera: the colour camera.
        depth_m: z, metres; zero, negative, NaN and infinite values mean no measurement.
        confidence: of each depth pixel; None if it was not recorded.
        min_confidence: pixels with less are left out; None for the default.
    """
    least = MIN_CONFIDENCE if min_confidence is None else min_confidence
    if confidence is not None:
        depth_m = np.where(confidence >= least, depth_m, np.float32(0))
    depth_camera = resized(camera, depth_m.shape[1], depth_m.shape[0])
    cloud, in_color_m = registered(depth_m, depth_camera, RigidTransform.identity(), rgb, camera)
    if len(cloud) == 0:
        raise FrameError(
            path,
            f"no pixel has a depth of confidence {least} or more, so the cloud is empty",
            "use the other frames, or give a lower --min-confidence",
        )
    return cloud, in_color_m


def rotation_of(quaternion: Sequence[float]) -> Rotation | None:
    """Returns the rotation of a quaternion x y z w; None if it is not one."""
    values = np.array(quaternion, np.float64)
    return Rotation.from_quat(values) if abs(np.linalg.norm(values) - 1) <= MOST_OFF_UNIT else None


def turns_to_upright(ups: Float64[np.ndarray, "n 3"]) -> int:
    """Returns how many quarter turns clockwise bring a recording's images upright, 0 if the camera looks down or up.

    `ups` are unit vectors against gravity in the camera's frame, of some of its images.
    """
    x, y = ups[:, :2].mean(axis=0) if len(ups) else (0.0, 0.0)
    return 0 if np.hypot(x, y) < LEAST_UPRIGHT else round(np.arctan2(-x, -y) / (np.pi / 2)) % 4


def turned(camera: Camera, turns: int) -> Camera:
    """Returns the camera (without distortion) of images that are turned clockwise by quarter turns."""
    for _ in range(turns):
        cx, cy = camera.height_px - 1 - camera.cy, camera.cx
        camera = Camera(camera.height_px, camera.width_px, camera.fy, camera.fx, cx, cy)
    return camera


# ARKit's world has y up; as a recording's, it has z up: x stays.
T_WORLD_ARKIT = RigidTransform.from_rotation(Rotation.from_matrix(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])))


def up_in_camera(T_world_camera: RigidTransform) -> Float64[np.ndarray, "3"]:
    """Returns the unit vector against gravity in the camera's frame, given its pose in a world with z up."""
    return np.asarray(T_world_camera.rotation.inv().apply([0.0, 0.0, 1.0]))


def unpack(data: bytes, most_bytes: int) -> bytes:
    """Returns what LZFSE compressed; runs in the `fence`."""
    import lzfse

    try:
        raw = bytes(lzfse.decompress(data))
    except lzfse.error as error:
        raise ValueError("its compression (LZFSE) is damaged") from error
    if len(raw) > most_bytes:
        raise ValueError(f"it has {len(raw)} bytes instead of {most_bytes}")
    return raw


@lru_cache(maxsize=4)
def _archive(path: Path, changed_ns: int, size: int, process: int) -> zipfile.ZipFile:
    """Returns an archive, which stays open: its list of files is long. By process, since a fork shares its place."""
    check_file(path)
    return zipfile.ZipFile(path)


def _opened(path: Path) -> zipfile.ZipFile:
    stat = path.stat()
    try:
        return _archive(path, stat.st_mtime_ns, stat.st_size, os.getpid())
    except ARCHIVE_ERRORS as error:
        raise ValueError(f"not a complete zip archive ({error})") from error


def list_entries(path: Path) -> frozenset[str]:
    if path.is_dir():
        return frozenset(file.relative_to(path).as_posix() for form in ("*", "*/*") for file in path.glob(form))
    return frozenset(_opened(path).namelist())


def read_entry(path: Path, name: str) -> bytes:
    if path.is_dir():
        return read_frame_file(path / name)
    archive = _opened(path)
    size = archive.getinfo(name).file_size
    require_memory(more_bytes=size)
    try:
        with archive.open(name) as file:
            # without a number, it unpacks up to 2 GiB of what follows, whatever the archive declares
            return file.read(size)
    except ARCHIVE_ERRORS as error:
        raise ValueError(f"the archive is damaged here ({error})") from error


SUFFIX, METADATA, FOLDER = ".r3d", "metadata", "rgbd/"
REMEDY = "export the recording again"
# Depth sizes of the back and the front camera (long side, short side), for files that do not name them.
DEPTH_SIZES = {256 * 192: (256, 192), 640 * 480: (640, 480)}
T_OPENGL_CAMERA = RigidTransform.from_rotation(Rotation.from_matrix(np.diag([1.0, -1.0, -1.0])))
# The first pose of a recording is the identity up to single precision if poses are relative to it.
IDENTITY_RAD = 1e-3
S_TO_NS = 1e9
IMAGE = re.compile(r"rgbd/([0-9]{1,9})\.(?:jpg|depth)")


class Metadata(FileRecord):
    """`metadata`; other keys (cameraType, initPose, ...) are ignored, and older files lack those with a default.

    Attributes:
        w, h, dw, dh: sizes of the colour and the depth images.
        K: the camera matrix of the colour images, column by column.
        perFrameIntrinsicCoeffs: fx fy cx cy of each image.
        poses: qx qy qz qw x y z of each image.
        frameTimestamps: seconds since the first image.
    """

    w: Side
    h: Side
    dw: Side | None = None
    dh: Side | None = None
    K: Annotated[tuple[Number, ...], Field(min_length=9, max_length=9)]
    fps: Positive | None = None
    perFrameIntrinsicCoeffs: tuple[tuple[Number, Number, Number, Number], ...] = ()
    poses: tuple[tuple[Number, Number, Number, Number, Number, Number, Number], ...] = ()
    frameTimestamps: tuple[Number, ...] = ()


@dataclass(frozen=True, eq=False)
class Record3D(Recording):
    """A `Recording` of Record3D. Frames are named by their numbers."""

    metadata: Metadata
    entries: frozenset[str] = field(repr=False)
    min_confidence: int | None = None
    format: ClassVar[str] = "record3d"
    is_sequence: ClassVar[bool] = True

    @property
    def notes(self) -> tuple[str, ...]:
        notes = []
        if self.metadata.poses and not self._knows_gravity:
            notes.append("The recording's poses start at its first image, so the direction of gravity is not known.")
        if self.min_confidence is not None and not any(name.endswith(".conf") for name in self.entries):
            notes.append("The recording has no confidence, so that --min-confidence has no effect.")
        return tuple(notes)

    def frame(self, i: int) -> Frame:
        key = self.key(i)
        rgb = self._image(key)
        camera = self._camera(i, rgb)
        depth_path, depth_m = self._plane(key, "depth", np.float32, camera)
        confidence = self._plane(key, "conf", np.uint8, camera)[1] if f"{FOLDER}{key}.conf" in self.entries else None
        cloud, in_color_m = phone_cloud(
            depth_path, camera, rgb, in_metres(depth_m, 1.0), confidence, self.min_confidence
        )
        T = self.pose(i)
        up = None if T is None or not self._knows_gravity else up_in_camera(T)
        return Frame(key, i, camera, rgb, cloud, in_color_m, up, None, self._time_ns(i), T_world_camera=T)

    @property
    def pose_source(self) -> str | None:
        return METADATA if self.metadata.poses else None

    def pose(self, i: int) -> RigidTransform | None:
        self.key(i)
        place = self._place(i, len(self.metadata.poses))
        if place is None or (turn := rotation_of(self.metadata.poses[place][:4])) is None:
            return None
        T_arkit_opengl = RigidTransform.from_components(self.metadata.poses[place][4:], turn)
        return T_WORLD_ARKIT * T_arkit_opengl * T_OPENGL_CAMERA

    def _image(self, key: str) -> UInt8[np.ndarray, "h w 3"]:
        import cv2

        path, data = self._read(f"{key}.jpg")
        with file_errors(path, REMEDY):
            bgr = decode_image(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB))

    def _camera(self, i: int, rgb: UInt8[np.ndarray, "h w 3"]) -> Camera:
        """Returns the colour camera of an image, whose intrinsics change while the phone focuses."""
        meta, (height, width) = self.metadata, rgb.shape[:2]
        K = np.array(meta.K).reshape(3, 3).T
        at = self._place(i, len(meta.perFrameIntrinsicCoeffs))
        if at is not None:
            (K[0, 0], K[1, 1], K[0, 2], K[1, 2]) = meta.perFrameIntrinsicCoeffs[at]
        if not is_pinhole(K):
            raise FrameError(self.path / METADATA, "K is not a camera matrix, column by column", REMEDY)
        if width * meta.h != height * meta.w:
            raise FrameError(
                self.path / f"{FOLDER}{self.keys[i]}.jpg",
                f"the image is {width} x {height} pixels, but the metadata has {meta.w} x {meta.h}",
                REMEDY,
            )
        camera = pinhole(K, meta.w, meta.h)
        return camera if (width, height) == (meta.w, meta.h) else resized(camera, width, height)

    def _plane(self, key: str, suffix: str, dtype: type[np.generic], camera: Camera) -> tuple[Path, np.ndarray]:
        path, data = self._read(f"{key}.{suffix}")
        if find_spec("lzfse") is None:
            raise MissingExtraError("lzfse", "phones")
        with file_errors(path, REMEDY):
            width, height = self.metadata.dw or 0, self.metadata.dh or 0
            if width * height:
                require_pixels(width, height, give_points=True)
            own = np.dtype(dtype).newbyteorder("<")
            most_bytes = own.itemsize * (width * height or max(DEPTH_SIZES))
            pixels = np.frombuffer(fenced(f"{__name__}:unpack", data, most_bytes), own).astype(dtype)
            if not width * height:
                if pixels.size not in DEPTH_SIZES:
                    raise ValueError(f"the size of its {pixels.size} pixels is unknown (no dw and dh in metadata)")
                width, height = DEPTH_SIZES[pixels.size]
                if camera.height_px > camera.width_px:
                    width, height = height, width
            if pixels.size != width * height:
                raise ValueError(f"it has {pixels.size} pixels instead of {width} x {height}")
        return path, pixels.reshape(height, width)

    def _read(self, name: str) -> tuple[Path, bytes]:
        path = self.path / f"{FOLDER}{name}"
        if FOLDER + name not in self.entries:
            raise FrameError(path, "missing", REMEDY)
        with file_errors(path, REMEDY, "cannot be read: "):
            return path, read_entry(self.path, FOLDER + name)

    def _place(self, i: int, length: int) -> int | None:
        """Returns the place of frame `i` in a list of the metadata: by order, or by number if some were removed."""
        place = i if length == len(self.keys) else int(self.keys[i])
        return place if place < length else None

    @cached_property
    def _known_times_ns(self) -> Times:
        times = known_times(tuple(round(time * S_TO_NS) for time in self.metadata.frameTimestamps))
        return () if all(time is None for time in times) else times

    def _time_ns(self, i: int) -> int | None:
        place, fps = self._place(i, len(self._known_times_ns)), self.metadata.fps
        if place is not None:
            return self._known_times_ns[place]
        time_ns = LATEST_NS + 1 if fps is None else round(int(self.keys[i]) / fps * S_TO_NS)
        return None if time_ns > LATEST_NS else time_ns

    @cached_property
    def _knows_gravity(self) -> bool:
        """True unless poses are missing, or relative to the first one."""
        place = self._place(0, len(self.metadata.poses))
        first = None if place is None else rotation_of(self.metadata.poses[place][:4])
        return first is not None and bool(first.magnitude() > IDENTITY_RAD)


def is_record3d(path: Path) -> bool:
    """True for a file or folder of Record3D, by its name; much faster than opening it."""
    is_file = path.suffix.lower() == SUFFIX and path.is_file()
    return is_file or ((path / METADATA).is_file() and (path / FOLDER).is_dir())


def open_record3d(path: Path, options: ReaderOptions) -> Record3D | None:
    """Opens the Record3D recording at `path`; None if it is not one."""
    if not is_record3d(path):
        return None
    with file_errors(path, REMEDY, kind=RecordingError):
        entries = list_entries(path)
    numbers = {found[1] for name in entries if (found := IMAGE.fullmatch(name))}
    keys = sorted_keys(path, numbers, f"{FOLDER}0.jpg and so on")
    if METADATA not in entries:
        raise RecordingError(f"{path}: has no file {METADATA}; {REMEDY}")
    with file_errors(path / METADATA, REMEDY, kind=RecordingError):
        metadata = Metadata.model_validate_json(read_entry(path, METADATA))
    return Record3D(path, keys, metadata, entries, options.min_confidence)
