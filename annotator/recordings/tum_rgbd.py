"""TUM's RGB-D format: images that are named by time, and lists of them.

rgb.txt, depth.txt    a line `timestamp file` for each image; seconds, `#` begins a comment
rgb/, depth/          PNG or JPEG; uint16, 5000 units per metre, registered to the colour images
groundtruth.txt       optional: `timestamp tx ty tz qx qy qz qw`, pose of the colour camera in the world, in time order
camera_intrinsic.json optional; also depth_intrinsic.json, as in an RGB-D folder

Format: cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats. Each colour image is paired with the depth image nearest
in time, closest pairs first, as TUM's own tool does. The data set's world has z up, so poses tell the direction of
gravity; the worlds of other recordings in this format are not known.
"""

from __future__ import annotations

import os
import re
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import ClassVar

import numpy as np
from jaxtyping import Int64, UInt8
from scipy.spatial.transform import RigidTransform

from annotator.files import TABLE_BYTES, read_text_file, why_missing
from annotator.recordings.image_file import read_color_image
from annotator.recordings.listing import IMAGE_SUFFIXES, file_errors
from annotator.recordings.poses import Poses, numbers
from annotator.recordings.recording import ReaderOptions, Recording
from annotator.recordings.rgbd_folder import FILE_NAME, RgbdCamera, read_camera, read_images
from annotator.text import OutsideError, inside, normal, posix_path, stem_of
from annotator.types import Camera, Frame
from annotator.types.checks import seconds_ns
from annotator.types.errors import FrameError, RecordingError
from annotator.types.messages import amount

RGB_LIST, DEPTH_LIST, POSES = "rgb.txt", "depth.txt", "groundtruth.txt"
UNITS_PER_M = 5000.0
# The camera that TUM recommends for all its recordings, whose depth was registered with it.
CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
# Part of the names of TUM's own recordings.
OWN_NAME = "freiburg"
TOLERANCE_S = 0.02
S_TO_NS = 10**9
Z = np.array([0.0, 0.0, 1.0])
# A colour image is compared with this many depth images before and after it.
NEIGHBOURS = 3
REMEDY = "correct the line, or remove it"
# Between the values of a line, as in TUM's own tools.
SEPARATOR = re.compile(r"[\s,]+")
# Seconds and their decimals, with blanks between the values.
DECIMAL_COMMA = re.compile(r"\d+,\d+\s")


@dataclass(frozen=True, eq=False)
class TumRgbd(Recording):
    """A `Recording` in TUM's format. Frames are named by their colour images, and have the times of these.

    Attributes:
        images: the colour and the depth image of each frame, relative to the folder.
        tolerance_ns: largest difference in time of an image and its partner.
        unpaired: number of colour images without a depth image within the tolerance.
        poses: of the colour camera; None without groundtruth.txt.
    """

    images: tuple[tuple[str, str], ...] = field(repr=False)
    times_ns: tuple[int, ...] = field(repr=False)
    tolerance_ns: int
    unpaired: int
    poses: Poses | None
    format: ClassVar[str] = "tum_rgbd"
    is_sequence: ClassVar[bool] = True
    is_parallel: ClassVar[bool] = True

    @property
    def notes(self) -> tuple[str, ...]:
        notes = []
        if self.unpaired:
            within_s = self.tolerance_ns / S_TO_NS
            alone = amount(self.unpaired, "colour image")
            notes.append(f"Left out: {alone} without a depth image within {within_s:g} s.")
        if not (self.path / FILE_NAME).is_file() and OWN_NAME not in self.name:
            notes.append(
                f"The camera is the one that TUM recommends for its own recordings; write {FILE_NAME} for others."
            )
        return tuple(notes)

    @property
    def file_owners(self) -> dict[str, str]:
        """The key of the frame that each image belongs to."""
        return {file: key for key, files in zip(self.keys, self.images, strict=True) for file in files}

    def files(self, i: int) -> tuple[Path, Path]:
        self.key(i)
        color, depth = self.images[i]
        return self._file(color), self._file(depth)

    def image(self, i: int) -> UInt8[np.ndarray, "h w 3"]:
        return read_color_image(self.files(i)[0], self._camera().size, has_depth=True).rgb

    def frame(self, i: int) -> Frame:
        """Reads frame `i` with `depth_m`; its cloud has `rgb` and `pixel_index`."""
        key, (color, depth) = self.key(i), self.files(i)
        camera = self._camera()
        image, cloud, depth_m = read_images(self.path, color, depth, camera)
        T = self.pose(i)
        # the worlds of other recordings may be those of their first image
        up = T.rotation.inv().apply(Z) if T is not None and OWN_NAME in self.path.resolve().name else None
        moment = {"timestamp_ns": self.times_ns[i], "T_world_camera": T}
        return image.frame(key, i, camera.camera, cloud, depth_m=depth_m, up=up, **moment)

    @property
    def pose_source(self) -> str | None:
        return None if self.poses is None else self.poses.source

    def pose(self, i: int) -> RigidTransform | None:
        self.key(i)
        return None if self.poses is None else self.poses.at(i, self.times_ns[i])

    def _camera(self) -> RgbdCamera:
        camera = RgbdCamera(self.path / FILE_NAME, CAMERA, UNITS_PER_M)
        return read_camera(camera.path, UNITS_PER_M) if camera.path.is_file() else camera

    def _file(self, name: str) -> Path:
        """Returns the path of a listed file, which must lie in the folder, or in one that is linked into it."""
        try:
            return inside(self.path, name)
        except OutsideError as error:
            first, *rest = PurePosixPath(name).parts
            if rest and first not in ("/", "//", os.pardir) and why_missing(self.path / first) is None:
                with suppress(OutsideError):
                    return inside(self.path / first, "/".join(rest))
            raise FrameError(self.path, f"the listed file {error}") from error


def open_tum_rgbd(path: Path, options: ReaderOptions) -> TumRgbd | None:
    """Opens the recording in TUM's format at `path`; None if it is not one."""
    if not ((path / RGB_LIST).is_file() and (path / DEPTH_LIST).is_file()):
        return None
    tolerance_s = TOLERANCE_S if options.tolerance_s is None else options.tolerance_s
    tolerance_ns = round(tolerance_s * S_TO_NS)
    (color_times, colors), (depth_times, depths) = (_listed(path / name) for name in (RGB_LIST, DEPTH_LIST))
    pairs = _pairs(color_times, depth_times, tolerance_ns)
    keys = tuple(stem_of(colors[at]) for at, _ in pairs)
    if not pairs:
        raise RecordingError(
            f"{path}: no frames; none of its colour images ({len(colors)}) has a depth image within {tolerance_s:g} s; "
            "give a larger --tolerance"
        )
    if len({*map(normal, keys)}) < len(keys):
        raise RecordingError(f"{path / RGB_LIST}: two images have the same name; rename one of them")
    return TumRgbd(
        path,
        keys,
        tuple((colors[at], depths[partner]) for at, partner in pairs),
        tuple(int(color_times[at]) for at, _ in pairs),
        tolerance_ns,
        len(colors) - len(pairs),
        _poses(path / POSES),
    )


def _lines(path: Path) -> list[tuple[int, str]]:
    with file_errors(path, "correct or copy it", kind=RecordingError):
        lines = read_text_file(path, TABLE_BYTES).split("\n")
    rows = [(number, line.strip()) for number, line in enumerate(lines, 1)]
    rows = [(number, line) for number, line in rows if line and not line.startswith("#")]
    for number, line in rows:
        if DECIMAL_COMMA.match(line):
            raise RecordingError(f"{path}:{number}: begins with a time with a decimal comma; write a point")
    return rows


def _time_ns(path: Path, number: int, text: str) -> int:
    try:
        return seconds_ns(text)
    except ValueError as error:
        raise RecordingError(f"{path}:{number}: {error}; {REMEDY}") from error


def _listed(path: Path) -> tuple[Int64[np.ndarray, "n"], list[str]]:
    """Returns the times (ns) and files of a list, in time order."""
    images = []
    for number, line in _lines(path):
        time, rest = (*SEPARATOR.split(line, maxsplit=1), "")[:2]
        # further columns are ignored, but a name may have blanks
        names = (SEPARATOR.split(rest)[0], rest)
        name = next((name for name in map(posix_path, names) if name.lower().endswith(IMAGE_SUFFIXES)), None)
        if name is None:
            raise RecordingError(f"{path}:{number}: must be a time and a PNG or JPEG file; {REMEDY}")
        images.append((_time_ns(path, number, time), name))
    images.sort()
    unset = sum(time == 0 for time, _ in images)
    if unset > 1:
        raise RecordingError(
            f"{path}: the time of {amount(unset, 'image')} is 0, so they have no partners by time; write their times"
        )
    return np.array([time for time, _ in images], np.int64), [name for _, name in images]


def _pairs(times: Int64[np.ndarray, "n"], others: Int64[np.ndarray, "m"], tolerance_ns: int) -> list[tuple[int, int]]:
    """Pairs each time with at most one of the others, closest pairs first; returns them by time."""
    if not len(others):
        return []
    near = np.searchsorted(others, times)[:, None] + np.arange(-NEIGHBOURS, NEIGHBOURS)
    possible = (near >= 0) & (near < len(others))
    apart = np.abs(others[near.clip(0, len(others) - 1)] - times[:, None])
    first, column = np.nonzero(possible & (apart <= tolerance_ns))
    order = np.argsort(apart[first, column], kind="stable")
    partner: dict[int, int] = {}
    taken: set[int] = set()
    for at, other in zip(first[order].tolist(), near[first, column][order].tolist(), strict=True):
        if at not in partner and other not in taken:
            partner[at] = other
            taken.add(other)
    return sorted(partner.items())


def _poses(path: Path) -> Poses | None:
    if not path.is_file():
        return None
    rows = []
    for line, text in _lines(path):
        time, *words = SEPARATOR.split(text)
        if len(words) != 7:
            raise RecordingError(f"{path}:{line}: must be a time, a place and a unit quaternion; {REMEDY}")
        rows.append((line, _time_ns(path, line, time), numbers(path, line, words)))
    # as the lists of images: their lines may be in any order
    return Poses.listed(path, sorted(rows, key=lambda row: row[1]))
