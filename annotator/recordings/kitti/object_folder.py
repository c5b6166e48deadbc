"""KITTI object detection folders: unrelated single frames.

[training/]image_2/KEY.png  velodyne/KEY.bin  calib/KEY.txt  [label_2/KEY.txt]
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from annotator.file_names import spelled
from annotator.recordings.kitti.folder import KittiFolder, keys_in, require_calibration
from annotator.recordings.kitti_frame import KittiCalibration, read_calibration
from annotator.recordings.options import ReaderOptions
from annotator.recordings.recording import NotFound
from annotator.recordings.scan_file import Scans

LOOKED_FOR = "folders image_2/ and velodyne/ (and calib/), here or in training/"


@dataclass(frozen=True, eq=False)
class KittiObject(KittiFolder):
    """A `Recording` of a KITTI object folder.

    Attributes:
        folder: the folder of images and scans, `path` or `path`/training.
    """

    folder: Path
    format: ClassVar[str] = "kitti_object"
    is_sequence: ClassVar[bool] = False
    images: ClassVar[str] = "image_2"
    scans: ClassVar[str] = "velodyne"

    @property
    def root(self) -> Path:
        return self.folder

    def calibration(self, key: str) -> KittiCalibration:
        return read_calibration(spelled(self.root / "calib", f"{key}.txt"))

    def time_ns(self, number: int) -> None:
        """Unrelated frames have no time."""


def open_kitti_object(path: Path, options: ReaderOptions) -> KittiObject | NotFound:
    """Opens the KITTI object folder at `path` or `path`/training; `NotFound` if there is none.

    Raises:
        RecordingError: the folders exist but have no frame, or there is no calibration.
    """
    for root in (path, path / "training"):
        keys = keys_in(root, KittiObject.images, KittiObject.scans)
        if keys is not None:
            require_calibration(root, "a KITTI object folder", "calib/", "velodyne/")
            return KittiObject(path, keys, root, reader=Scans(options.columns))
    return NotFound(LOOKED_FOR)
