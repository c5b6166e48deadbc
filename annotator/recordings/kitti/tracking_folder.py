"""KITTI tracking: consecutive frames of one drive, 10 a second; or the data set, where each drive is a scene.

image_02/KEY.png  velodyne/KEY.bin  calib.txt  [label_02.txt]
[training/]image_02/DRIVE/KEY.png  velodyne/DRIVE/KEY.bin  calib/DRIVE.txt  [label_02/DRIVE.txt]

Labels are read by annotator.formats.kitti_rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from annotator.recordings.kitti.calibration import KittiCalibration, read_calibration
from annotator.recordings.kitti.folder import KittiFolder, keys_in, require_calibration
from annotator.recordings.listing import sorted_keys
from annotator.recordings.options import ReaderOptions
from annotator.recordings.recording import NotFound
from annotator.recordings.scan_file import Scans
from annotator.types.errors import ConfigError

LOOKED_FOR = "folders image_02/ and velodyne/ (and calib.txt), or image_02/0000/, velodyne/0000/ (and calib/0000.txt)"
IMAGES, SCANS = "image_02", "velodyne"


@dataclass(frozen=True, eq=False)
class KittiTracking(KittiFolder):
    """A `Recording` of one KITTI drive; its times count from the drive's frame 0."""

    format: ClassVar[str] = "kitti_tracking"
    is_sequence: ClassVar[bool] = True
    images: ClassVar[str] = IMAGES
    scans: ClassVar[str] = SCANS

    @property
    def label_file(self) -> Path:
        """The file of the labels, which may be missing."""
        return self.root / "label_02.txt"

    def calibration(self, key: str) -> KittiCalibration:
        return read_calibration(self.path / "calib.txt")


@dataclass(frozen=True, eq=False)
class KittiSequence(KittiTracking):
    """One drive of a KITTI tracking data set.

    Attributes:
        folder: of the data set, `path` or `path`/training.
        scene: name of the drive.
        scenes: names of all drives.
        notes: what was left out.
    """

    folder: Path
    scene: str
    scenes: tuple[str, ...]
    notes: tuple[str, ...] = ()

    @property
    def root(self) -> Path:
        return self.folder

    @property
    def name(self) -> str:
        return self.scene

    @property
    def images(self) -> str:  # type: ignore[override]
        return f"{IMAGES}/{self.scene}"

    @property
    def scans(self) -> str:  # type: ignore[override]
        return f"{SCANS}/{self.scene}"

    @property
    def label_file(self) -> Path:
        return self.root / "label_02" / f"{self.scene}.txt"

    def calibration(self, key: str) -> KittiCalibration:
        return read_calibration(self.root / "calib" / f"{self.scene}.txt")


def open_kitti_tracking(path: Path, options: ReaderOptions) -> KittiTracking | NotFound:
    """Opens the KITTI tracking folder at `path`, or a drive of the data set there; `NotFound` if it is neither.

    Takes the options `columns` and, of a data set, `scene`; without it, the first drive is read.

    Raises:
        ConfigError: no such drive.
        RecordingError: the folders exist but have no frame, or there is no calibration.
    """
    for root in (path, path / "training"):
        drives = _drives(root)
        if drives:
            return _sequence(path, root, drives, options)
    keys = keys_in(path, IMAGES, SCANS)
    if keys is None:
        return NotFound(LOOKED_FOR)
    if options.scene is not None:
        raise ConfigError(f"{path}: is one drive of KITTI, which takes no --scene")
    require_calibration(path, "a KITTI tracking folder", "calib.txt", "velodyne/")
    return KittiTracking(path, keys, reader=Scans(options.columns))


def _drives(root: Path) -> list[str]:
    """Returns the drives of a data set that have a calibration."""
    if not (root / IMAGES).is_dir():
        return []
    return sorted(file.stem for file in (root / "calib").glob("*.txt") if (root / IMAGES / file.stem).is_dir())


def _sequence(path: Path, root: Path, drives: list[str], options: ReaderOptions) -> KittiSequence:
    scene = options.scene or drives[0]
    if scene not in drives:
        raise ConfigError(f"{path}: has no scene {scene}; it has {', '.join(drives)}")
    images, scans = f"{IMAGES}/{scene}", f"{SCANS}/{scene}"
    keys = keys_in(root, images, scans) or sorted_keys(root, set(), f"{images}/KEY.png and {scans}/KEY.bin")
    notes: tuple[str, ...] = ()
    if len(drives) > 1 and options.scene is None:
        notes = (f"{len(drives)} drives: {', '.join(drives)}; this is the first (--scene names another, or all)",)
    return KittiSequence(path, keys, root, scene, tuple(drives), notes, reader=Scans(options.columns))
