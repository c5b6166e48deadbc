"""The labels of a dataset, row by row: a row that is wrong is told, and the others are still read.

`workflows.truth` reads the same files for everybody else, and refuses a file with one wrong row.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

from scipy.spatial.transform import RigidTransform

from annotator.formats.boxes_json import entry_truth, read_entries
from annotator.formats.kitti import DONT_CARE, KittiLabel, parse_fields, parse_tracking_fields, row_truth
from annotator.formats.sunrgbd_labels import extracted_truth
from annotator.formats.text_folder import text_rows
from annotator.recordings import Recording
from annotator.types import Frame, Truth
from annotator.types.errors import AnnotatorError, FormatError
from annotator.workflows.truth import label_file, load_truth


@dataclass(frozen=True, eq=False)
class FoundLabel:
    """One object and where it stands.

    Attributes:
        truth: in the camera frame (in the labels' own where the frame could not be read).
        line: of its row, where the format has lines.
        row: as KITTI writes it, where it does.
        rejected: somebody has looked at it and it is no object; it may lie on another.
    """

    truth: Truth
    file: Path
    line: int | None = None
    row: KittiLabel | None = None
    rejected: bool = False


@dataclass(frozen=True, eq=False)
class FrameLabels:
    """The objects of a frame in file order, and what was wrong with others; `missing`: there should be a file."""

    objects: tuple[FoundLabel, ...] = ()
    problems: tuple[AnnotatorError, ...] = ()
    missing: Path | None = None


@runtime_checkable
class LabelFiles(Protocol):
    """The label files of a dataset."""

    def of(self, index: int, key: str, frame: Frame | None) -> FrameLabels:
        """The labels of a frame; `frame` None = it could not be read, and what its labels need of it is not known."""

    def problems(self) -> Sequence[AnnotatorError]:
        """What is wrong with files of the whole dataset, and labels of frames that are not there."""

    def strays(self) -> Iterator[tuple[Path, int | None, str]]:
        """File, line and name of labels whose frames are not there; FormatError: a list of frames cannot be read."""


RowParser = Callable[[list[str], RigidTransform | None, Path, int], FoundLabel | None]


@dataclass(frozen=True)
class RowFiles:
    """A text file a frame, a row an object."""

    recording: Recording
    folder: Path
    parse: RowParser

    def of(self, index: int, key: str, frame: Frame | None) -> FrameLabels:
        path = self.folder / f"{key}.txt"
        if not path.is_file():
            return FrameLabels(missing=path)
        try:
            rows = text_rows(path)
        except FormatError as error:
            return FrameLabels(problems=(error,))
        objects, problems = [], []
        T = None if frame is None else frame.T_camera_label
        for line, fields in rows:
            try:
                found = self.parse(fields, T, path, line)
            except FormatError as error:
                problems.append(error)
            else:
                if found is not None:
                    objects.append(found)
        return FrameLabels(tuple(objects), tuple(problems))

    def problems(self) -> Sequence[AnnotatorError]:
        return ()

    def strays(self) -> Iterator[tuple[Path, int | None, str]]:
        keys = set(self.recording.keys)
        for path in sorted(self.folder.glob("*.txt")):
            if path.stem not in keys:
                yield path, None, path.stem


@dataclass(frozen=True)
class TrackingFile:
    """KITTI's `label_02.txt`: all frames in one file, kept while the check lasts."""

    recording: Recording
    path: Path
    rows: dict[int, list[FoundLabel]] = field(default_factory=lambda: defaultdict(list))
    wrong: list[AnnotatorError] = field(default_factory=list)

    def read(self) -> TrackingFile:
        """Reads the file."""
        try:
            for line, fields in text_rows(self.path):
                self._take(line, fields)
        except FormatError as error:
            self.wrong.append(error)
        return self

    def _take(self, line: int, fields: list[str]) -> None:
        try:
            number, track_id, row = parse_tracking_fields(fields, self.path, line)
            if row.label != DONT_CARE:
                truth = row_truth(row, track_id, None, self.path, line)
                self.rows[number].append(FoundLabel(truth, self.path, line, row))
        except FormatError as error:
            self.wrong.append(error)

    def of(self, index: int, key: str, frame: Frame | None) -> FrameLabels:
        if not key.isdecimal():
            return FrameLabels(problems=(FormatError(self.path, f"counts frames by number, and {key!r} is none"),))
        found = self.rows.get(int(key), ())
        return FrameLabels(tuple(_moved(each, frame) for each in found))

    def problems(self) -> Sequence[AnnotatorError]:
        return self.wrong

    def strays(self) -> Iterator[tuple[Path, int | None, str]]:
        numbers = {int(key) for key in self.recording.keys if key.isdecimal()}
        for number, rows in self.rows.items():
            if number not in numbers:
                yield self.path, rows[0].line, str(number)


@dataclass(frozen=True)
class BoxesFile:
    """`boxes.json`: all frames in one file, kept while the check lasts."""

    recording: Recording
    path: Path
    entries: dict[str, list[object]] = field(default_factory=dict)
    wrong: list[AnnotatorError] = field(default_factory=list)

    def read(self) -> BoxesFile:
        """Reads the file."""
        try:
            self.entries.update(read_entries(self.path))
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
class WholeFiles:
    """Labels of any other format, as everybody else reads them: one wrong object is the whole file's fault."""

    recording: Recording

    def of(self, index: int, key: str, frame: Frame | None) -> FrameLabels:
        file = label_file(self.recording, key) or self.recording.path
        if not file.exists():
            return FrameLabels(missing=file)
        if frame is None:
            return FrameLabels()
        try:
            truths = load_truth(self.recording, index, frame)
        except AnnotatorError as error:
            return FrameLabels(problems=(error,))
        return FrameLabels(tuple(FoundLabel(truth, file) for truth in truths))

    def problems(self) -> Sequence[AnnotatorError]:
        return ()

    def strays(self) -> Iterator[tuple[Path, int | None, str]]:
        return iter(())


def label_files(recording: Recording) -> LabelFiles | None:
    """The label files of a recording, or None where it has none of its own."""
    file = next((found for key in recording.keys[:1] if (found := label_file(recording, key))), None)
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


def _kitti_row(fields: list[str], T: RigidTransform | None, path: Path, line: int) -> FoundLabel | None:
    row = parse_fields(fields, path, line)
    return None if row.label == DONT_CARE else FoundLabel(row_truth(row, None, T, path, line), path, line, row)


def _extracted_row(fields: list[str], T: RigidTransform | None, path: Path, line: int) -> FoundLabel:
    return FoundLabel(extracted_truth(fields, T, path, line), path, line)


def _moved(found: FoundLabel, frame: Frame | None) -> FoundLabel:
    """The label in the camera frame."""
    T = None if frame is None else frame.T_camera_label
    if T is None:
        return found
    return replace(found, truth=replace(found.truth, box=found.truth.box.transformed(T)))
