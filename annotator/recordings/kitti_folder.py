"""What all KITTI folders have in common: a folder of images, one of LiDAR scans, and keys that name one of each."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from annotator.recordings.kitti_calib import KittiCalibration
from annotator.recordings.kitti_frame import read_frame
from annotator.recordings.listing import IMAGE_SUFFIXES, frame_file, sorted_keys, stems
from annotator.recordings.recording import KeyedFrames
from annotator.types import Frame

# KITTI's sensors are triggered by the spinning LiDAR, ten times a second.
PERIOD_NS = 100_000_000


@dataclass(frozen=True, eq=False)
class KittiFolder(KeyedFrames, ABC):
    """A `Recording` of image and scan pairs.

    Attributes:
        images, scans: their folders, below `root`.
    """

    images: ClassVar[str]
    scans: ClassVar[str]

    def frame(self, i: int) -> Frame:
        """Frame `i`; labels are in rectified camera 0 (`T_camera_label`).

        Raises:
            FrameError: a missing or broken file, or no point in the image.
            IndexError: there is no such frame.
        """
        key = self.key(i)
        # the number in a name tells when it was, gaps included
        number = int(key) if key.isascii() and key.isdigit() else i
        return read_frame(
            key,
            i,
            frame_file(self.root / self.images, key, IMAGE_SUFFIXES, f"{self.scans}/{key}.bin"),
            frame_file(self.root / self.scans, key, (".bin",), f"the image {key}"),
            self.calibration(key),
            self.time_ns(number),
        )

    @abstractmethod
    def calibration(self, key: str) -> KittiCalibration:
        """The calibration of a frame.

        Raises:
            FrameError: it is missing or broken.
        """

    def time_ns(self, number: int) -> int | None:
        """When frame `number` of the drive was, counted from its frame 0.

        Raises:
            FrameError: the drive's own times are broken.
        """
        return number * PERIOD_NS

    @classmethod
    def keys_in(cls, root: Path) -> tuple[str, ...] | None:
        """The keys of this kind of folder, or None where `root` is none.

        Raises:
            RecordingError: it is one, but holds no frame.
        """
        images, scans = root / cls.images, root / cls.scans
        if not (images.is_dir() and scans.is_dir()):
            return None
        wanted = f"{cls.images}/KEY.png and {cls.scans}/KEY.bin"
        return sorted_keys(root, stems(images, IMAGE_SUFFIXES) | stems(scans, (".bin",)), wanted)
