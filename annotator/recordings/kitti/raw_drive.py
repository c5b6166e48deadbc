"""KITTI raw drives, in the layout of the download ("synced and rectified").

DRIVE/image_02/data/KEY.png  DRIVE/velodyne_points/data/KEY.bin  DRIVE/image_02/timestamps.txt
calib_cam_to_cam.txt  calib_velo_to_cam.txt    in the drive's folder, or in the folder of its day above it
[tracklet_labels.xml, read by annotator.formats.kitti_tracklets]
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

from annotator.files import TABLE_BYTES, read_text_file
from annotator.recordings.kitti.calibration import KittiCalibration, read_raw_calibration
from annotator.recordings.kitti.folder import PERIOD_NS, KittiFolder, keys_in
from annotator.recordings.options import ReaderOptions
from annotator.recordings.recording import NotFound
from annotator.recordings.scan_file import Scans
from annotator.types.errors import FrameError

LOOKED_FOR = "folders image_02/data/ and velodyne_points/data/ (and calib_*.txt, here or in the folder above)"
CAMERAS, LIDAR = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt"
TIME = re.compile(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)(?:\.(\d{1,9}))?")


@dataclass(frozen=True, eq=False)
class KittiRaw(KittiFolder):
    """A `Recording` of one KITTI raw drive.

    Times come from `timestamps.txt`, read as UTC; its first line is the drive's frame 0. Without that file, times count
    from the drive's frame 0.
    """

    format: ClassVar[str] = "kitti_raw"
    is_sequence: ClassVar[bool] = True
    images: ClassVar[str] = "image_02/data"
    scans: ClassVar[str] = "velodyne_points/data"

    def calibration(self, key: str) -> KittiCalibration:
        for folder in (self.path, self.path.resolve().parent):
            if (folder / CAMERAS).is_file() or (folder / LIDAR).is_file():
                return read_raw_calibration(folder / CAMERAS, folder / LIDAR)
        raise FrameError(
            self.path / CAMERAS, "the calibration is missing", f"copy {CAMERAS} and {LIDAR} of the drive's day there"
        )

    def time_ns(self, number: int) -> int:
        path = self.path / "image_02" / "timestamps.txt"
        if not path.is_file():
            return number * PERIOD_NS
        try:
            stat = path.stat()
            times = _times(path, stat.st_mtime_ns, stat.st_size)
        except (OSError, UnicodeDecodeError) as error:
            raise FrameError(path, f"cannot be read ({error})", "copy it again from the data set") from error
        time_ns = times[number] if number < len(times) else None
        if time_ns is None:
            raise FrameError(
                path,
                f"line {number + 1} must be the time of frame {number}",
                "copy it again, or remove it to use times from the frame numbers",
            )
        return time_ns


@lru_cache(maxsize=4)
def _times(path: Path, changed_ns: int, size: int) -> tuple[int | None, ...]:
    """Returns the time of each line, nanoseconds since the epoch; None for an invalid line."""
    return tuple(_nanoseconds(line) for line in read_text_file(path, TABLE_BYTES).splitlines())


def _nanoseconds(line: str) -> int | None:
    match = TIME.fullmatch(line.strip())
    if match is None:
        return None
    try:
        moment = datetime.fromisoformat(match[1]).replace(tzinfo=UTC)
    except ValueError:  # such as the 31st of February
        return None
    return int(moment.timestamp()) * 1_000_000_000 + int((match[2] or "0").ljust(9, "0"))


def open_kitti_raw(path: Path, options: ReaderOptions) -> KittiRaw | NotFound:
    """Opens the KITTI raw drive at `path`; `NotFound` if it is not one. Takes the option `columns`.

    Raises:
        RecordingError: the folders exist but have no frame.
    """
    keys = keys_in(path, KittiRaw.images, KittiRaw.scans)
    return NotFound(LOOKED_FOR) if keys is None else KittiRaw(path, keys, reader=Scans(options.columns))
