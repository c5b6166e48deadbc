"""Reads the labels of a dataset row by row: invalid rows are reported, the others are still read.

`workflows.recorded.reading` reads the same files for all other uses and refuses a file with an invalid row.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

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
from annotator.formats.rcv import FOLDERS, SPLITS, RcvDataset
from annotator.formats.reading import text_rows
from annotator.formats.sunrgbd import extracted_truth
from annotator.formats.units import Angles
from annotator.recordings import Recording
from annotator.recordings.kitti import KittiObject
from annotator.recordings.listing import IMAGE_SUFFIXES, stems
from annotator.recordings.sunrgbd import SunRgbdExtracted
from annotator.text import normal, spelled
from annotator.types import Frame, ReviewState, Truth
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


Stray = tuple[Path, int | None, str]
"""A file that refers to a missing frame, the line in it (None: the file's name refers to it), and the frame's name."""
Entry = Callable[[], FoundLabel | bool]
"""Returns the label of a row; True for a 2D box without a 3D box, False for a row that is no label."""


@dataclass(frozen=True, eq=False)
class LabelFiles:
    """The label files of a dataset.

    Attributes:
        of: returns the labels of a frame, by its number, key, and the frame; None if it could not be read.
        problems: those of files that hold the labels of all frames.
        strays: yields labels whose frame is missing; raises FormatError if a list of frames cannot be read.
    """

    of: Callable[[int, str, Frame | None], FrameLabels]
    problems: Sequence[AnnotatorError] = ()
    strays: Callable[[], Iterator[Stray]] = lambda: iter(())


def _read(entries: Iterable[Entry]) -> FrameLabels:
    """Reads rows; invalid ones do not hide the others."""
    found, problems = list[FoundLabel | bool](), list[AnnotatorError]()
    for entry in entries:
        try:
            found.append(entry())
        except AnnotatorError as error:
            problems.append(error)
    objects = tuple(each for each in found if isinstance(each, FoundLabel))
    return FrameLabels(objects, tuple(problems), flat=found.count(True))


def _row_files(
    recording: Recording,
    folder: Path,
    parse: Callable[[list[str], RigidTransform | None, Path, int], FoundLabel | bool],
) -> LabelFiles:
    """One text file per frame, one row per object."""

    def of(index: int, key: str, frame: Frame | None) -> FrameLabels:
        path = spelled(folder, f"{key}.txt")
        if not path.is_file():
            return FrameLabels(missing=path)
        try:
            rows = text_rows(path)
        except FormatError as error:
            return FrameLabels(problems=(error,))
        T = None if frame is None else frame.T_camera_label
        return _read(partial(parse, fields, T, path, line) for line, fields in rows)

    return LabelFiles(of, strays=lambda: _without_frame(folder.glob("*.txt"), recording.keys))


def _without_frame(files: Iterable[Path], keys: Iterable[str]) -> Iterator[Stray]:
    known = set(map(normal, keys))
    return ((file, None, file.stem) for file in sorted(files) if normal(file.stem) not in known)


def _tracking_file(recording: Recording, path: Path) -> LabelFiles:
    """KITTI's `label_02.txt`: all frames in one file, kept in memory during the check."""
    rows: dict[int, list[FoundLabel]] = defaultdict(list)
    flat: Counter[int] = Counter()

    def add(line: int, fields: list[str]) -> bool:
        number, track_id, row = parse_tracking_fields(fields, path, line)
        flat[number] += row.label != DONT_CARE and row.is_flat
        if has_solid(row):
            # all angles of a dataset are judged together
            rows[number].append(FoundLabel(row_truth(row, track_id, None, path, line, Angles()), path, line, row))
        return False

    try:
        problems = _read(partial(add, *row) for row in text_rows(path)).problems
    except FormatError as error:
        problems = (error,)

    def of(index: int, key: str, frame: Frame | None) -> FrameLabels:
        if not key.isdecimal():
            return FrameLabels(problems=(FormatError(path, f"frames must have numbers as names, not {key!r}"),))
        T, found = None if frame is None else frame.T_camera_label, rows.get(int(key), ())
        if T is not None:
            found = [replace(each, truth=replace(each.truth, box=each.truth.box.transformed(T))) for each in found]
        return FrameLabels(tuple(found), flat=flat[int(key)])

    def strays() -> Iterator[Stray]:
        known = {int(key) for key in recording.keys if key.isdecimal()}
        return ((path, found[0].line, str(number)) for number, found in rows.items() if number not in known)

    return LabelFiles(of, problems, strays)


def _boxes_file(recording: Recording, path: Path) -> LabelFiles:
    """`boxes.json`: all frames in one file, kept in memory during the check."""
    entries: dict[str, list[object]] = {}
    known, problems = set(recording.keys), tuple[AnnotatorError, ...]()
    try:
        entries = dict(each_entries(path))
    except FormatError as error:
        problems = (error,)

    def entry(key: str, number: int) -> FoundLabel:
        return FoundLabel(entry_truth(entries[key][number], path, key, number), path)

    return LabelFiles(
        lambda _, key, frame: _read(partial(entry, key, number) for number in range(len(entries.get(key, ())))),
        problems,
        lambda: ((path, None, key) for key in entries if key not in known),
    )


def _whole_files(recording: Recording) -> LabelFiles:
    """Labels of any other format, read file by file: an invalid object makes the whole file invalid."""

    def of(index: int, key: str, frame: Frame | None) -> FrameLabels:
        file = label_file(recording, key) or recording.path
        if not file.exists():
            return FrameLabels(missing=file)
        if frame is None or not is_labelled(recording, key):
            return FrameLabels()
        try:
            return FrameLabels(tuple(FoundLabel(truth, file) for truth in load_truth(recording, index, frame)))
        except AnnotatorError as error:
            return FrameLabels(problems=(error,))

    return LabelFiles(of)


def rcv_files(dataset: RcvDataset) -> LabelFiles:
    """The label files of an `rcv` dataset."""
    frames = dataset.manifest.frames

    def of(index: int, key: str, frame: Frame | None) -> FrameLabels:
        path = dataset.label_path(index)
        if not path.is_file():
            return FrameLabels(missing=path)
        try:
            labels = dataset.labels(index)
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

    def strays() -> Iterator[Stray]:
        for folder in FOLDERS:
            yield from _without_frame((dataset.path / folder).glob("*"), frames)
        for file in sorted((dataset.path / SPLITS).glob("*.txt")):
            yield from _not_listed(file, map(normal, frames))

    return LabelFiles(of, strays=strays)


def label_files(recording: Recording) -> LabelFiles | None:
    """Returns the label files of a recording; None if it has none."""
    file = label_file(recording, recording.keys[0]) if recording.keys else None
    if file is None:
        return None
    match recording.format:
        case "kitti_object":
            return _row_files(recording, file.parent, _kitti_row)
        case "sunrgbd_extracted":
            return _row_files(recording, file.parent, _extracted_row)
        case "kitti_tracking":
            return _tracking_file(recording, file)
        case "rgbd_folder":
            return _boxes_file(recording, file)
    return _whole_files(recording)


def _kitti_row(fields: list[str], T: RigidTransform | None, path: Path, line: int) -> FoundLabel | bool:
    row = parse_fields(fields, path, line)
    if not has_solid(row):
        return row.label != DONT_CARE
    # all angles of a dataset are judged together
    return FoundLabel(row_truth(row, None, T, path, line, Angles()), path, line, row)


def _extracted_row(fields: list[str], T: RigidTransform | None, path: Path, line: int) -> FoundLabel:
    return FoundLabel(extracted_truth(fields, T, path, line), path, line)


LISTS, INDICES = "ImageSets", "*_data_idx.txt"
# KITTI's test frames, whose labels are not public: their folder, and their list.
TESTING, TEST_LIST = "testing", "test.txt"


def stray_names(recording: Recording) -> Iterator[Stray]:
    """Yields calibrations and list entries without a frame.

    Lists are `ImageSets/*.txt` of KITTI (beside `training`, or in the folder itself) and VoteNet's `*_data_idx.txt`,
    which have the frames' numbers without leading zeros.
    """
    if isinstance(recording, KittiObject):
        yield from _without_frame((recording.root / "calib").glob("*.txt"), recording.keys)
        yield from _image_sets(recording)
    elif isinstance(recording, SunRgbdExtracted):
        yield from _without_frame((recording.path / "calib").glob("*.txt"), recording.keys)
        for file in sorted(recording.path.glob(INDICES)):
            yield from _not_listed(file, {int(key) for key in recording.keys if key.isdecimal()}, int)


def _image_sets(recording: KittiObject) -> Iterator[Stray]:
    # the recording may have been opened at training/ or at the folder above
    folders = [recording.root, *([recording.root.parent] if recording.root.name == "training" else [])]
    keys = set(map(normal, recording.keys))
    for folder in folders:
        pictures = folder / TESTING / recording.images
        testing = set(map(normal, stems(pictures, IMAGE_SUFFIXES))) if pictures.is_dir() else set()
        for file in sorted((folder / LISTS).glob("*.txt")):
            # without testing/, test.txt lists frames elsewhere, except in exports, which have them in training/
            if file.name != TEST_LIST:
                yield from _not_listed(file, keys)
            elif testing or has_frames(folder):
                yield from _not_listed(file, keys | testing)


def _not_listed(file: Path, known: Iterable[object], named: Callable[[str], object] = normal) -> Iterator[Stray]:
    """Yields the frames in a list that are not known. Raises FormatError: the list is not text."""
    every = set(known)
    for line, (name, *_) in text_rows(file):
        with suppress(ValueError):  # no number
            if named(name) in every:
                continue
        yield file, line, name
