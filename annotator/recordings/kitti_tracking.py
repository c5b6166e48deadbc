"""KITTI tracking-style folders: consecutive frames of one drive, 10 a second.

image_02/KEY.png  velodyne/KEY.bin  calib.txt  [label_02.txt, read by annotator.formats.kitti]
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from annotator.recordings.kitti_calib import read_calibration
from annotator.recordings.kitti_frame import read_frame
from annotator.recordings.listing import IMAGE_SUFFIXES, frame_file, sorted_keys, stems
from annotator.recordings.recording import NotFound, frame_key
from annotator.types import Frame

LOOKED_FOR = "folders image_02/ and velodyne/ (and calib.txt)"
# KITTI's sensors are triggered by the spinning LiDAR, ten times a second.
PERIOD_NS = 100_000_000


@dataclass(frozen=True)
class KittiTracking:
    """A `Recording` of one KITTI drive.

    Times count from the drive's frame 0: the number in a frame's name tells when it was, gaps included.
    """

    path: Path
    keys: tuple[str, ...]
    format: str = "kitti_tracking"
    is_sequence: bool = True

    @property
    def root(self) -> Path:
        return self.path

    @property
    def name(self) -> str:
        return self.path.resolve().name

    def __len__(self) -> int:
        return len(self.keys)

    def frame(self, i: int) -> Frame:
        """Frame `i`; labels are in rectified camera 0 (`T_camera_label`).

        Raises:
            FrameError: a missing or broken file, or no point in the image.
            IndexError: there is no such frame.
        """
        key = frame_key(self.keys, i)
        number = int(key) if key.isascii() and key.isdigit() else i
        return read_frame(
            key,
            i,
            frame_file(self.path / "image_02", key, IMAGE_SUFFIXES, f"velodyne/{key}.bin"),
            frame_file(self.path / "velodyne", key, (".bin",), f"the image {key}"),
            read_calibration(self.path / "calib.txt"),
            number * PERIOD_NS,
        )


def open_kitti_tracking(path: Path) -> KittiTracking | NotFound:
    """The KITTI tracking folder at `path`, where it is one.

    Raises:
        RecordingError: the folders are there, but hold no frame.
    """
    images, scans = path / "image_02", path / "velodyne"
    if not (images.is_dir() and scans.is_dir()):
        return NotFound(LOOKED_FOR)
    keys = stems(images, IMAGE_SUFFIXES) | stems(scans, (".bin",))
    return KittiTracking(path, sorted_keys(path, keys, "image_02/KEY.png and velodyne/KEY.bin"))
