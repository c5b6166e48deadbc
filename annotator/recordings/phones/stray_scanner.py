"""Stray Scanner, an app for iPhones and iPads: a folder for each recording.

rgb.mp4                 the colour images (HEVC)
depth/NNNNNN.png        uint16, millimetres; in older versions NNNNNN.npy
confidence/NNNNNN.png   uint8, 0 to 2; optional
camera_matrix.csv       the camera matrix of the colour images, three rows
odometry.csv            a row for each image: timestamp (s), frame, x y z (m), qx qy qz qw; since 2024 also fx fy cx cy

`imu.csv` is not read. Format: github.com/strayrobots/scanner, docs/format.md. The poses are camera to world, with
OpenCV's camera axes (x right, y down, z forward) and ARKit's world (y up). The video's images belong to the rows in
their order. Images are recorded as the sensor lies, so those of a phone that was held upright are turned by a quarter.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Never, TypeVar

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.files import TABLE_BYTES, read_text_file
from annotator.frame_limits import read_frame_file
from annotator.geometry.projection import in_metres
from annotator.recordings.clouds.cloud_file import read_array
from annotator.recordings.frame_times import Times, known_times
from annotator.recordings.image_file import open_video, read_confidence, read_depth
from annotator.recordings.listing import file_errors, frame_file, require_size
from annotator.recordings.phones.record3d import (
    T_WORLD_ARKIT,
    phone_cloud,
    rotation_of,
    turned,
    turns_to_upright,
    up_in_camera,
)
from annotator.recordings.plausible import LARGEST, are_plausible, is_pinhole, pinhole
from annotator.recordings.recording import ReaderOptions, Recording
from annotator.text import to_number
from annotator.types import Camera, Frame
from annotator.types.errors import FrameError, RecordingError

VIDEO, POSES, MATRIX, DEPTH, CONFIDENCE = "rgb.mp4", "odometry.csv", "camera_matrix.csv", "depth", "confidence"
QUATERNION, INTRINSICS = ("qx", "qy", "qz", "qw"), ("fx", "fy", "cx", "cy")
REMEDY = "copy the recording from the phone again, or remove the frame"
MM_PER_M, S_TO_NS = 1000.0, 1e9
# Number of frames that tell how the phone was held.
SOME = 200
Value = TypeVar("Value")


@dataclass(frozen=True, eq=False)
class StrayScanner(Recording):
    """A `Recording` of Stray Scanner. Frames are named by the numbers in `odometry.csv`.

    `rows` are those of `odometry.csv`, as text by column; so many clockwise quarter `turns` bring the images upright.
    Pixels of less than `min_confidence` are left out; None for the default.
    """

    rows: tuple[dict[str, str], ...] = field(repr=False)
    turns: int = 0
    min_confidence: int | None = None
    format: ClassVar[str] = "stray_scanner"
    is_sequence: ClassVar[bool] = True

    @property
    def notes(self) -> tuple[str, ...]:
        notes = []
        if self.turns:
            notes.append(f"The images are turned clockwise by {90 * self.turns} degrees, since the phone was held so.")
        if self.min_confidence is not None and not (self.path / CONFIDENCE).is_dir():
            notes.append(f"There is no {CONFIDENCE}/, so that --min-confidence has no effect.")
        try:
            images = len(open_video(self.path / VIDEO))
            if images != len(self):
                lengths = f"{VIDEO} has {images} images, but {POSES} has {len(self)} rows"
                notes.append(f"{lengths}; they are taken to begin at the same time.")
        except (OSError, ValueError):  # each frame reports it
            pass
        return tuple(notes)

    def files(self, i: int) -> tuple[Path, ...]:
        key = self.key(i)
        depth = frame_file(self.path / DEPTH, key, (".png", ".npy"), VIDEO)
        if not (self.path / CONFIDENCE).is_dir():
            return (depth,)
        return depth, frame_file(self.path / CONFIDENCE, key, (".png",), f"{DEPTH}/{key}.png")

    def frame(self, i: int) -> Frame:
        key, path = self.key(i), self.path / VIDEO
        with file_errors(path, REMEDY, f"frame {key}: "):
            rgb = open_video(path).image(i)
        camera = turned(self._camera(i, rgb), self.turns)
        rgb = self._turned(rgb)
        depth_path, *confidence_path = self.files(i)
        depth_m, confidence = self._turned(_depth_m(depth_path)), None
        for path in confidence_path:
            confidence = self._turned(read_confidence(path))
            require_size(path, confidence, depth_m.shape[::-1], "the depth image has", REMEDY)
        cloud, in_color_m = phone_cloud(depth_path, camera, rgb, depth_m, confidence, self.min_confidence)
        self._time_ns(i)  # raises for a damaged one
        up, time_ns, T = up_in_camera(self._turned_pose(i, self.turns)), self._times_ns[i], self.pose(i)
        return Frame(key, i, camera, rgb, cloud, in_color_m, up, None, time_ns, T_world_camera=T)

    @property
    def pose_source(self) -> str | None:
        return POSES if self.has_places else None

    def pose(self, i: int) -> RigidTransform | None:
        self.key(i)
        return self._turned_pose(i, self.turns) if self.has_places else None

    @property
    def has_places(self) -> bool:
        return all(name in self.rows[0] for name in "xyz")

    def _turned_pose(self, i: int, turns: int) -> RigidTransform:
        """Returns the pose of the camera whose images are turned; at the origin without places."""
        turn = rotation_of(self._numbers(i, QUATERNION))
        if turn is None:
            self._raise(i, "qx qy qz qw is not a rotation")
        place_m = self._numbers(i, "xyz") if self.has_places else [0.0, 0.0, 0.0]
        T_camera_turned = RigidTransform.from_rotation(Rotation.from_euler("z", -90 * turns, degrees=True))
        return T_WORLD_ARKIT * RigidTransform.from_components(place_m, turn) * T_camera_turned

    def _camera(self, i: int, rgb: UInt8[np.ndarray, "h w 3"]) -> Camera:
        """Returns the colour camera of an image, whose intrinsics change while the phone focuses."""
        path, K = self.path / POSES, np.eye(3)
        if all(self.rows[i].get(name) for name in INTRINSICS):
            (K[0, 0], K[1, 1], K[0, 2], K[1, 2]) = self._numbers(i, INTRINSICS)
        else:
            path = self.path / MATRIX
            K = _matrix(path)
        if not is_pinhole(K):
            raise FrameError(path, f"frame {self.keys[i]}: it has no camera matrix", REMEDY)
        return pinhole(K, rgb.shape[1], rgb.shape[0])

    def _time_ns(self, i: int) -> int:
        return round(self._numbers(i, ("timestamp",))[0] * S_TO_NS)

    @cached_property
    def _times_ns(self) -> Times:
        """The times of all frames; None for those that are not set, or damaged, which each frame reports."""
        return known_times(tuple(_or_none(self._time_ns, i) for i in range(len(self))))

    def _turned(self, image: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(np.rot90(image, -self.turns))

    def _numbers(self, i: int, columns: Sequence[str]) -> list[float]:
        try:
            numbers = [to_number(self.rows[i][name]) for name in columns]
        except ValueError as error:
            self._raise(i, f"{' '.join(columns)}: {error}")
        return numbers if are_plausible(np.array(numbers)) else self._raise(i, f"{' '.join(columns)} is implausible")

    def _raise(self, i: int, problem: str) -> Never:
        raise FrameError(self.path / POSES, f"line {i + 2}: {problem}", REMEDY)


def open_stray_scanner(path: Path, options: ReaderOptions) -> StrayScanner | None:
    """Opens the recording of Stray Scanner at `path`; None if it is not one."""
    poses = path / POSES
    if not ((path / VIDEO).is_file() and poses.is_file() and (path / DEPTH).is_dir()):
        return None
    with file_errors(poses, "copy the recording from the phone again", kind=RecordingError):
        try:
            lines = csv.DictReader(io.StringIO(read_text_file(poses, TABLE_BYTES)), restval="", skipinitialspace=True)
            lines.fieldnames = [name.strip() for name in lines.fieldnames or ()]
            rows = tuple(lines)
        except csv.Error as error:
            raise ValueError(f"not a table ({error})") from error
    if not {"timestamp", "frame", *QUATERNION} <= {*lines.fieldnames}:
        raise RecordingError(
            f"{poses}:1: must name the columns timestamp, frame, qx, qy, qz, qw; record with a newer app"
        )
    if not rows:
        raise RecordingError(f"{poses}: no frames; record again, and stop the recording before leaving the app")
    keys = tuple(row["frame"].strip() for row in rows)
    seen: set[str] = set()
    for line, (key, row) in enumerate(zip(keys, rows, strict=True), 2):
        if None in row:
            raise RecordingError(f"{poses}:{line}: has more values than columns; decimals need a point, not a comma")
        if not (key.isascii() and key.isdecimal()) or key in seen:
            raise RecordingError(f"{poses}:{line}: frame {key[:40]!r} is not a number, or has a row already; {REMEDY}")
        seen.add(key)
    recording = StrayScanner(path, keys, rows, min_confidence=options.min_confidence)
    # by some frames with a sound row
    some = range(0, len(recording), len(recording) // SOME + 1)
    found = [_or_none(lambda i: recording._turned_pose(i, 0), i) for i in some]
    ups = [up_in_camera(T) for T in found if T is not None]
    return replace(recording, turns=turns_to_upright(np.array(ups).reshape(-1, 3)))


def _or_none(read: Callable[[int], Value], i: int) -> Value | None:
    try:
        return read(i)
    except FrameError:
        return None


def _depth_m(path: Path) -> Float32[np.ndarray, "h w"]:
    if path.suffix.lower() == ".png":
        raw: np.ndarray = read_depth(path)
    else:
        with file_errors(path, REMEDY):
            raw = read_array(io.BytesIO(read_frame_file(path)), is_image=True)
            if raw.ndim != 2 or raw.dtype.names is not None:
                raise ValueError("it is not an image of numbers")
    return in_metres(raw, MM_PER_M)


def _matrix(path: Path) -> Float64[np.ndarray, "3 3"]:
    with file_errors(path, REMEDY):
        numbers = [to_number(text) for line in read_text_file(path).splitlines() for text in line.split(",")]
    if len(numbers) != 9 or not np.all(np.abs(numbers) <= LARGEST):
        raise FrameError(path, "it is not a camera matrix of three rows", REMEDY)
    return np.array(numbers).reshape(3, 3)
