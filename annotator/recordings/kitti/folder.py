"""The common base of all KITTI folders: an image folder and a folder of LiDAR scans with the same keys."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np

from annotator.geometry.transforms import level_pose
from annotator.recordings.kitti_frame import UP, KittiCalibration, read_frame
from annotator.recordings.listing import IMAGE_SUFFIXES, frame_file, joined, sorted_keys, stems
from annotator.recordings.recording import KeyedFrames
from annotator.recordings.rig import Scan
from annotator.recordings.scan_file import Scans
from annotator.types import Frame
from annotator.types.errors import RecordingError

# The rotating LiDAR triggers KITTI's sensors ten times a second.
PERIOD_NS = 100_000_000
# KITTI's names have 6 or 10 digits; times of longer numbers would not fit into 64 bits.
MOST_DIGITS = 10


@dataclass(frozen=True, eq=False)
class KittiFolder(KeyedFrames, ABC):
    """A `Recording` of image and scan pairs.

    Attributes:
        images, scans: their folders, relative to `root`.
        reader: reads the scans.
    """

    reader: Scans = field(default_factory=Scans, kw_only=True)
    images: ClassVar[str]
    scans: ClassVar[str]
    is_parallel: ClassVar[bool] = True

    def files(self, i: int) -> tuple[Path, Path]:
        key = self.key(i)
        image = frame_file(self.root / self.images, key, IMAGE_SUFFIXES, f"{self.scans}/{key}.bin")
        return image, self._scan_file(key)

    def frame(self, i: int) -> Frame:
        """Reads frame `i`; labels are in rectified camera 0 (`T_camera_label`).

        Raises:
            FrameError: a missing or broken file, or no point in the image.
            IndexError: there is no such frame.
        """
        key, (image, scan) = self.key(i), self.files(i)
        return read_frame(key, i, image, scan, self.reader, self.calibration(key), self._time_of(i))

    def scan(self, i: int) -> Scan:
        """Reads the whole scan of frame `i`.

        Raises:
            FrameError: a missing or broken file.
            IndexError: there is no such frame.
        """
        key = self.key(i)
        points = self.reader.read(self._scan_file(key))
        calibration = self.calibration(key)
        return Scan(
            points.xyz_m.astype(np.float64),
            None,
            points.reflectance,
            level_pose(UP).rotation * calibration.T_camera_lidar.rotation,
            np.zeros(3),
            calibration.T_camera_lidar.inv() * calibration.T_camera_label,
            timestamp_ns=self._time_of(i),
        )

    def _scan_file(self, key: str) -> Path:
        return frame_file(self.root / self.scans, key, (".bin",), f"the image {key}")

    def _time_of(self, i: int) -> int | None:
        """Returns the time of frame `i`: the key's number determines it, so gaps are kept."""
        key = self.keys[i]
        return self.time_ns(int(key) if key.isascii() and key.isdigit() and len(key) <= MOST_DIGITS else i)

    @abstractmethod
    def calibration(self, key: str) -> KittiCalibration:
        """Reads the calibration of a frame.

        Raises:
            FrameError: it is missing or broken.
        """

    def time_ns(self, number: int) -> int | None:
        """Returns the time of frame `number` of the drive, counted from its frame 0; None if frames have no time.

        Raises:
            FrameError: the drive's own times are broken.
        """
        return number * PERIOD_NS


def keys_in(root: Path, images: str, scans: str) -> tuple[str, ...] | None:
    """Returns the keys of the frames of two folders in `root`; None if these are not there.

    Raises:
        RecordingError: they have no frame.
    """
    if not ((root / images).is_dir() and (root / scans).is_dir()):
        return None
    expected = f"{images}/KEY.png and {scans}/KEY.bin"
    keys = joined(stems(root / images, IMAGE_SUFFIXES), stems(root / scans, (".bin",)))
    return sorted_keys(root, keys, expected)


def require_calibration(root: Path, looks_like: str, name: str, scans: str) -> None:
    """Refuses a folder of images and scans without a calibration, in place of an error for each frame.

    Raises:
        RecordingError: there is no `name`.
    """
    if not (root / name).exists():
        raise RecordingError(
            f"{root}: looks like {looks_like}: {name} is missing; copy it from the data set, or give the path of "
            f"{scans} to label the scans without images"
        )
