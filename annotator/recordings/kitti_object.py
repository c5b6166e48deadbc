"""KITTI object detection folders: unrelated single frames.

[training/]image_2/KEY.png  velodyne/KEY.bin  calib/KEY.txt  [label_2/KEY.txt, read by annotator.formats.kitti]
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from annotator.recordings.kitti_calib import read_calibration
from annotator.recordings.kitti_frame import read_frame
from annotator.recordings.listing import IMAGE_SUFFIXES, frame_file, sorted_keys, stems
from annotator.recordings.recording import NotFound, frame_key
from annotator.types import Frame

LOOKED_FOR = "folders image_2/ and velodyne/ (and calib/), here or in training/"


@dataclass(frozen=True)
class KittiObject:
    """A `Recording` of a KITTI object folder."""

    path: Path
    root: Path
    keys: tuple[str, ...]
    format: str = "kitti_object"
    is_sequence: bool = False

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
        return read_frame(
            key,
            i,
            frame_file(self.root / "image_2", key, IMAGE_SUFFIXES, f"velodyne/{key}.bin"),
            frame_file(self.root / "velodyne", key, (".bin",), f"the image {key}"),
            read_calibration(self.root / "calib" / f"{key}.txt"),
            None,
        )


def open_kitti_object(path: Path) -> KittiObject | NotFound:
    """The KITTI object folder at `path` or `path`/training, where there is one.

    Raises:
        RecordingError: the folders are there, but hold no frame.
    """
    for root in (path, path / "training"):
        images, scans = root / "image_2", root / "velodyne"
        if images.is_dir() and scans.is_dir():
            keys = stems(images, IMAGE_SUFFIXES) | stems(scans, (".bin",))
            return KittiObject(path, root, sorted_keys(root, keys, "image_2/KEY.png and velodyne/KEY.bin"))
    return NotFound(LOOKED_FOR)
