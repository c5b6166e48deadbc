"""Finds the datasets below a path: recordings with their own labels, and `rcv` datasets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from annotator.formats.rcv import FOLDERS, MANIFEST, SPLITS, RcvDataset, read_rcv
from annotator.recordings import Recording, open_recording
from annotator.recordings.clouds.cloud_folder import CloudFolder
from annotator.recordings.open import FILE_SUFFIXES
from annotator.recordings.sunrgbd import SunRgbdScenes
from annotator.text import normal, spelled
from annotator.types import Frame, ReviewState, Truth
from annotator.types.errors import AnnotatorError, FormatError, RecordingError, UnknownFormatError
from annotator.workflows.checking.label_files import FoundLabel, FrameLabels, LabelFiles, label_files
from annotator.workflows.checking.other_software import OtherSoftwareDataset, labels_alone, other_software_dataset
from annotator.workflows.checking.unmatched_names import frame_names

MOST_LEVELS = 4
# Calibration files of the formats; the first one that exists is used.
CALIBRATIONS = (
    "calib/{key}.txt",
    "calib.txt",
    "calib_cam_to_cam.txt",
    "../calib_cam_to_cam.txt",
    "camera_intrinsic.json",
)


@runtime_checkable
class Source(Protocol):
    """A dataset: frames that are read one at a time, and labels."""

    @property
    def path(self) -> Path:
        """The path that was opened."""

    @property
    def format(self) -> str:
        """The recording's format, or "rcv"."""

    @property
    def keys(self) -> Sequence[str]:
        """The frames' names."""

    @property
    def labels(self) -> LabelFiles | None:
        """The label files; None without labels."""

    @property
    def has_pictures(self) -> bool:
        """False if the images are rendered from the clouds."""

    @property
    def declared_objects(self) -> int | None:
        """The number of objects in the dataset's manifest; None without a manifest."""

    def place(self, index: int) -> tuple[str, int]:
        """Returns the original recording of a frame, and its number there."""

    @property
    def in_time_order(self) -> bool:
        """True if the frames' numbers are known to be in time order."""

    def read(self, index: int) -> Frame:
        """Reads a frame; raises an AnnotatorError if it cannot be read."""

    def calibration(self, index: int) -> Path:
        """Returns the file of a frame's camera."""


@dataclass(frozen=True)
class RecordingSource:
    """A recording."""

    recording: Recording
    labels: LabelFiles | None
    declared_objects: None = None

    @property
    def path(self) -> Path:
        return self.recording.path

    @property
    def format(self) -> str:
        return self.recording.format

    @property
    def keys(self) -> Sequence[str]:
        return self.recording.keys

    @property
    def has_pictures(self) -> bool:
        return not (isinstance(self.recording, CloudFolder) and self.recording.images is None)

    @property
    def in_time_order(self) -> bool:
        return self.recording.is_sequence

    def place(self, index: int) -> tuple[str, int]:
        return self.recording.name, index

    def read(self, index: int) -> Frame:
        return self.recording.frame(index)

    def calibration(self, index: int) -> Path:
        if isinstance(self.recording, SunRgbdScenes):
            return self.recording.scenes[index] / "intrinsics.txt"
        places = (spelled(self.recording.root, name.format(key=self.keys[index])) for name in CALIBRATIONS)
        return next((place for place in places if place.is_file()), self.path)


@dataclass(frozen=True)
class RcvSource:
    """An `rcv` dataset. Its frames may come from several recordings, which need not be sequences."""

    dataset: RcvDataset
    recording: Recording
    has_pictures: bool = True
    in_time_order: bool = False
    format: str = "rcv"

    @property
    def path(self) -> Path:
        return self.dataset.path

    @property
    def keys(self) -> Sequence[str]:
        return self.dataset.manifest.frames

    @property
    def declared_objects(self) -> int:
        return self.dataset.manifest.counts.objects

    @property
    def labels(self) -> LabelFiles:
        return RcvLabelFiles(self.dataset)

    def place(self, index: int) -> tuple[str, int]:
        return self.dataset.place(index)

    def read(self, index: int) -> Frame:
        return self.recording.frame(index)

    def calibration(self, index: int) -> Path:
        return self.dataset.label_path(index)


@dataclass(frozen=True)
class RcvLabelFiles:
    """The label files of an `rcv` dataset."""

    dataset: RcvDataset

    def of(self, index: int, key: str, frame: Frame | None) -> FrameLabels:
        path = self.dataset.label_path(index)
        if not path.is_file():
            return FrameLabels(missing=path)
        try:
            labels = self.dataset.labels(index)
        except FormatError as error:
            return FrameLabels(problems=(error,))
        return FrameLabels(
            tuple(
                FoundLabel(
                    Truth(each.label, each.box, each.track_id), path, rejected=each.state is ReviewState.REJECTED
                )
                for each in labels
            )
        )

    def problems(self) -> Sequence[AnnotatorError]:
        return ()

    def strays(self) -> Iterator[tuple[Path, int | None, str]]:
        frames = set(map(normal, self.dataset.manifest.frames))
        for folder in FOLDERS:
            for file in sorted((self.dataset.path / folder).glob("*")):
                if normal(file.stem) not in frames:
                    yield file, None, file.stem
        for file in sorted((self.dataset.path / SPLITS).glob("*.txt")):
            for line, name in frame_names(file):
                if normal(name) not in frames:
                    yield file, line, name


SourceOrError = Source | OtherSoftwareDataset | tuple[Path, AnnotatorError]


def find_sources(path: Path) -> Iterator[SourceOrError]:
    """Yields the datasets at `path`, else those below it; for one that cannot be opened, its path and the error.

    Raises:
        RecordingError: there is no dataset.
    """
    is_empty = True
    for source in _below(path, MOST_LEVELS):
        is_empty = False
        yield source
    if is_empty and (labels := labels_alone(path)) is not None:
        yield labels
    elif is_empty:
        # raises an error that says what the path looks like
        open_recording(path)


def _below(path: Path, levels: int) -> Iterator[SourceOrError]:
    dataset = other_software_dataset(path)
    if dataset is not None:
        source = _with_own_labels(path, dataset)
        if source is not None:
            yield source
            return
        yield dataset
        if not dataset.is_recording:
            return
    try:
        yield _open(path)
        return
    except UnknownFormatError:
        pass
    except (FormatError, RecordingError) as error:
        yield path, error
        return
    if levels == 0 or not path.is_dir():
        return
    for child in sorted(path.iterdir()):
        if not child.name.startswith(".") and (child.is_dir() or child.suffix.lower() in FILE_SUFFIXES):
            yield from _below(child, levels - 1)


def _with_own_labels(path: Path, dataset: OtherSoftwareDataset) -> Source | None:
    """Returns the recording whose own labels the sound dataset holds, so that its boxes can be checked."""
    faults: list[FormatError] = []
    try:
        source = _open(path) if dataset.opened_as is not None else None
    except AnnotatorError:
        return None
    if source is None or source.format != dataset.opened_as or source.labels is None:
        return None
    for _ in dataset.parts(faults.append):
        pass
    return None if faults else source


def _open(path: Path) -> Source:
    if (path / MANIFEST).is_file():
        return RcvSource(read_rcv(path), open_recording(path))
    recording = open_recording(path)
    return RecordingSource(recording, label_files(recording))
