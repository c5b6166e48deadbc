"""Reads the labels of a dataset row by row: invalid rows are reported, the others are still read.

`workflows.recorded.reading` reads the same files for all other uses and refuses a file with an invalid row.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from scipy.spatial.transform import RigidTransform

from annotator.formats.boxes_json import each_entries, entry_truth
from annotator.formats.frame_names import has_frames
from annotator.formats.kitti_rows import (
    DONT_CARE,
    KittiLabel,
    has_solid,
    parse_fields,
    parse_tracking_fields,
    row_truth,
)
from annotator.formats.reading import text_rows
from annotator.formats.sunrgbd import extracted_truth
from annotator.formats.units import Angles
from annotator.recordings import Recording
from annotator.recordings.kitti import KittiObject
from annotator.recordings.listing import IMAGE_SUFFIXES, stems
from annotator.recordings.sunrgbd import SunRgbdExtracted
from annotator.text import normal, spelled
from annotator.types import Frame, Truth
from annotator.types.errors import AnnotatorError, FormatError
from annotator.workflows.recorded.reading import is_labelled, label_file, load_truth


@dataclass(frozen=True, eq=False)
class FoundLabel:
    """One object and its place in a file.

    Attributes:
        truth: in the camera frame (in the labels' own frame if the frame could not be read).
        line: line of its row; None for formats without lines.
        row: its KITTI row; None for other formats.
        rejected: rejected in review; it may overlap other objects.
    """

    truth: Truth
    file: Path
    line: int | None = None
    row: KittiLabel | None = None
    rejected: bool = False


@dataclass(frozen=True, eq=False)
class FrameLabels:
    """The labels of a frame.

    Attributes:
        objects: in file order.
        problems: those of other rows.
        missing: the label file, if it is missing.
        flat: number of 2D boxes without a 3D box.
    """

    objects: tuple[FoundLabel, ...] = ()
    problems: tuple[AnnotatorError, ...] = ()
    missing: Path | None = None
    flat: int = 0


class LabelFiles(ABC):
    """The label files of a dataset."""

    @abstractmethod
    def of(self, index: int, key: str, frame: Frame | None) -> FrameLabels:
        """Returns the labels of a frame; `frame` is None if it could not be read."""

    def problems(self) -> Sequence[AnnotatorError]:
        """Returns the problems of files that hold the labels of all frames."""
        return ()

    def strays(self) -> Iterator[tuple[Path, int | None, str]]:
        """Yields file, line and frame name of labels whose frame is missing.

        Raises:
            FormatError: a list of frames cannot be read.
        """
        return iter(())


RowParser = Callable[[list[str], RigidTransform | None, Path, int], FoundLabel | Literal["area", "flat"]]
"""Returns the label of a row, or what the row has instead: a DontCare area, or a 2D box without a 3D box."""


@dataclass(frozen=True)
class RowFiles(LabelFiles):
    """One text file per frame, one row per object."""

    recording: Recording
    folder: Path
    parse: RowParser

    def of(self, index: int, key: str, frame: Frame | None) -> FrameLabels:
        path = spelled(self.folder, f"{key}.txt")
        if not path.is_file():
            return FrameLabels(missing=path)
        try:
            rows = text_rows(path)
        except FormatError as error:
            return FrameLabels(problems=(error,))
        objects, problems, flat = [], [], 0
        T = None if frame is None else frame.T_camera_label
        for line, fields in rows:
            try:
                label = self.parse(fields, T, path, line)
            except FormatError as error:
                problems.append(error)
            else:
                if isinstance(label, FoundLabel):
                    objects.append(label)
                flat += label == "flat"
        return FrameLabels(tuple(objects), tuple(problems), flat=flat)

    def strays(self) -> Iterator[tuple[Path, int | None, str]]:
        keys = set(map(normal, self.recording.keys))
        for path in sorted(self.folder.glob("*.txt")):
            if normal(path.stem) not in keys:
                yield path, None, path.stem


@dataclass(frozen=True)
class TrackingFile(LabelFiles):
    """KITTI's `label_02.txt`: all frames in one file, kept in memory during the check."""

    recording: Recording
    path: Path
    rows: dict[int, list[FoundLabel]] = field(default_factory=lambda: defaultdict(list))
    flat: Counter[int] = field(default_factory=Counter)
    wrong: list[AnnotatorError] = field(default_factory=list)

    def read(self) -> TrackingFile:
        """Reads the file."""
        try:
            for line, fields in text_rows(self.path):
                self._add_row(line, fields)
        except FormatError as error:
            self.wrong.append(error)
        return self

    def _add_row(self, line: int, fields: list[str]) -> None:
        try:
            number, track_id, row = parse_tracking_fields(fields, self.path, line)
            self.flat[number] += row.label != DONT_CARE and row.is_flat
            if has_solid(row):
                # all angles of a dataset are judged together
                truth = row_truth(row, track_id, None, self.path, line, Angles())
                self.rows[number].append(FoundLabel(truth, self.path, line, row))
        except FormatError as error:
            self.wrong.append(error)

    def of(self, index: int, key: str, frame: Frame | None) -> FrameLabels:
        if not key.isdecimal():
            return FrameLabels(problems=(FormatError(self.path, f"frames must have numbers as names, not {key!r}"),))
        labels = self.rows.get(int(key), ())
        return FrameLabels(tuple(_in_camera_frame(each, frame) for each in labels), flat=self.flat[int(key)])

    def problems(self) -> Sequence[AnnotatorError]:
        return self.wrong

    def strays(self) -> Iterator[tuple[Path, int | None, str]]:
        numbers = {int(key) for key in self.recording.keys if key.isdecimal()}
        for number, rows in self.rows.items():
            if number not in numbers:
                yield self.path, rows[0].line, str(number)


@dataclass(frozen=True)
class BoxesFile(LabelFiles):
    """`boxes.json`: all frames in one file, kept in memory during the check."""

    recording: Recording
    path: Path
    entries: dict[str, list[object]] = field(default_factory=dict)
    wrong: list[AnnotatorError] = field(default_factory=list)

    def read(self) -> BoxesFile:
        """Reads the file."""
        try:
            self.entries.update(dict(each_entries(self.path)))
        except FormatError as error:
            self.wrong.append(error)
        return self

    def of(self, index: int, key: str, frame: Frame | None) -> FrameLabels:
        objects, problems = [], []
        for number, entry in enumerate(self.entries.get(key, ())):
            try:
                objects.append(FoundLabel(entry_truth(entry, self.path, key, number), self.path))
            except FormatError as error:
                problems.append(error)
        return FrameLabels(tuple(objects), tuple(problems))

    def problems(self) -> Sequence[AnnotatorError]:
        return self.wrong

    def strays(self) -> Iterator[tuple[Path, int | None, str]]:
        keys = set(self.recording.keys)
        return ((self.path, None, key) for key in self.entries if key not in keys)


@dataclass(frozen=True)
class WholeFiles(LabelFiles):
    """Labels of any other format, read file by file: an invalid object makes the whole file invalid."""

    recording: Recording

    def of(self, index: int, key: str, frame: Frame | None) -> FrameLabels:
        file = label_file(self.recording, key) or self.recording.path
        if not file.exists():
            return FrameLabels(missing=file)
        if frame is None or not is_labelled(self.recording, key):
            return FrameLabels()
        try:
            truths = load_truth(self.recording, index, frame)
        except AnnotatorError as error:
            return FrameLabels(problems=(error,))
        return FrameLabels(tuple(FoundLabel(truth, file) for truth in truths))


def label_files(recording: Recording) -> LabelFiles | None:
    """Returns the label files of a recording; None if it has none."""
    file = label_file(recording, recording.keys[0]) if recording.keys else None
    if file is None:
        return None
    if recording.format == "kitti_object":
        return RowFiles(recording, file.parent, _kitti_row)
    if recording.format == "sunrgbd_extracted":
        return RowFiles(recording, file.parent, _extracted_row)
    if recording.format == "kitti_tracking":
        return TrackingFile(recording, file).read()
    if recording.format == "rgbd_folder":
        return BoxesFile(recording, file).read()
    return WholeFiles(recording)


def _kitti_row(
    fields: list[str], T: RigidTransform | None, path: Path, line: int
) -> FoundLabel | Literal["area", "flat"]:
    row = parse_fields(fields, path, line)
    if not has_solid(row):
        return "area" if row.label == DONT_CARE else "flat"
    # all angles of a dataset are judged together
    return FoundLabel(row_truth(row, None, T, path, line, Angles()), path, line, row)


def _extracted_row(fields: list[str], T: RigidTransform | None, path: Path, line: int) -> FoundLabel:
    return FoundLabel(extracted_truth(fields, T, path, line), path, line)


def _in_camera_frame(label: FoundLabel, frame: Frame | None) -> FoundLabel:
    """Returns the label in the camera frame."""
    T = None if frame is None else frame.T_camera_label
    if T is None:
        return label
    return replace(label, truth=replace(label.truth, box=label.truth.box.transformed(T)))


LISTS, INDICES = "ImageSets", "*_data_idx.txt"
# KITTI's test frames, whose labels are not public: their folder, and their list.
TESTING, TEST_LIST = "testing", "test.txt"

Stray = tuple[Path, int | None, str]
"""A file that refers to a missing frame, the line in it (None: the file's name refers to it), and the frame's name."""


def stray_names(recording: Recording) -> Iterator[Stray]:
    """Yields calibrations and list entries without a frame.

    Lists are `ImageSets/*.txt` of KITTI (beside `training`, or in the folder itself) and VoteNet's `*_data_idx.txt`,
    which have the frames' numbers without leading zeros.

    Raises:
        FormatError: a list cannot be read.
    """
    if isinstance(recording, KittiObject):
        yield from _calibrations(recording.root, recording)
        yield from _image_sets(recording)
    elif isinstance(recording, SunRgbdExtracted):
        yield from _calibrations(recording.path, recording)
        numbers = {int(key) for key in recording.keys if key.isdecimal()}
        for file in sorted(recording.path.glob(INDICES)):
            for line, name in frame_names(file):
                if not (name.isdecimal() and int(name) in numbers):
                    yield file, line, name


def _calibrations(folder: Path, recording: Recording) -> Iterator[Stray]:
    keys = set(map(normal, recording.keys))
    for file in sorted((folder / "calib").glob("*.txt")):
        if normal(file.stem) not in keys:
            yield file, None, file.stem


def _image_sets(recording: KittiObject) -> Iterator[Stray]:
    # the recording may have been opened at training/ or at the folder above
    folders = [recording.root, *([recording.root.parent] if recording.root.name == "training" else [])]
    keys = set(map(normal, recording.keys))
    for folder in folders:
        pictures = folder / TESTING / recording.images
        testing = set(map(normal, stems(pictures, IMAGE_SUFFIXES))) if pictures.is_dir() else set()
        for file in sorted((folder / LISTS).glob("*.txt")):
            # without testing/, test.txt lists frames elsewhere, except in exports, which have them in training/
            if file.name == TEST_LIST and not testing and not has_frames(folder):
                continue
            listed = keys | testing if file.name == TEST_LIST else keys
            for line, name in frame_names(file):
                if normal(name) not in listed:
                    yield file, line, name


def frame_names(file: Path) -> Iterator[tuple[int, str]]:
    """Returns line and name of each frame in a list.

    Raises:
        FormatError: the list is not text.
    """
    return ((line, words[0]) for line, words in text_rows(file))
