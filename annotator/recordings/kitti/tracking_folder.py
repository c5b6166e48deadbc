"""KITTI tracking-style folders: consecutive frames of one drive, 10 a second.

image_02/KEY.png  velodyne/KEY.bin  calib.txt  [label_02.txt, read by annotator.formats.kitti.label_files]
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from annotator.recordings.kitti.calibration import KittiCalibration, read_calibration
from annotator.recordings.kitti.folder import KittiFolder, require_calibration
from annotator.recordings.options import ReaderOptions
from annotator.recordings.recording import NotFound
from annotator.recordings.scan_file import Scans

LOOKED_FOR = "folders image_02/ and velodyne/ (and calib.txt)"


@dataclass(frozen=True, eq=False)
class KittiTracking(KittiFolder):
    """A `Recording` of one KITTI drive; its times count from the drive's frame 0."""

    format: ClassVar[str] = "kitti_tracking"
    is_sequence: ClassVar[bool] = True
    images: ClassVar[str] = "image_02"
    scans: ClassVar[str] = "velodyne"

    def calibration(self, key: str) -> KittiCalibration:
        return read_calibration(self.path / "calib.txt")


def open_kitti_tracking(path: Path, options: ReaderOptions) -> KittiTracking | NotFound:
    """Opens the KITTI tracking folder at `path`; `NotFound` if it is not one. Takes the option `columns`.

    Raises:
        RecordingError: the folders exist but have no frame, or there is no calibration.
    """
    keys = KittiTracking.keys_in(path)
    if keys is None:
        return NotFound(LOOKED_FOR)
    require_calibration(path, "a KITTI tracking folder", "calib.txt", "velodyne/")
    return KittiTracking(path, keys, reader=Scans(options.columns))
