"""Files and lists of a dataset that refer to frames which it does not have."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from annotator.formats.frame_names import has_frames
from annotator.formats.rcv import FOLDERS, SPLITS
from annotator.formats.reading import text_rows
from annotator.recordings import Recording
from annotator.recordings.kitti import KittiObject
from annotator.recordings.listing import IMAGE_SUFFIXES, stems
from annotator.recordings.sunrgbd import SunRgbdExtracted
from annotator.text import normal
from annotator.types.errors import FormatError
from annotator.workflows.recorded.reading import NO_FRAME, label_file, labels_by_frame

Stray = tuple[Path, int | None, str]
"""A file that refers to a missing frame, the line in it (None: the file's name refers to it), and the frame's name."""


def _without_frame(files: Iterable[Path], keys: Iterable[str]) -> Iterator[Stray]:
    known = set(map(normal, keys))
    return ((file, None, file.stem) for file in sorted(files) if normal(file.stem) not in known)


LISTS, INDICES = "ImageSets", "*_data_idx.txt"
# KITTI's test frames, whose labels are not public: their folder, and their list.
TESTING, TEST_LIST = "testing", "test.txt"


def stray_names(recording: Recording) -> Iterator[Stray]:
    """Yields labels, calibrations, files of an export and list entries without a frame.

    Lists are `ImageSets/*.txt` of KITTI (beside `training`, or in the folder itself), VoteNet's `*_data_idx.txt`, which
    have the frames' numbers without leading zeros, and `splits/*.txt` of annotator's exports.

    Raises:
        FormatError: a list is not text.
    """
    labels = label_file(recording, recording.keys[0]) if recording.keys else None
    if labels is not None and recording.format in ("kitti_object", "sunrgbd_extracted"):
        yield from _without_frame(labels.parent.glob("*.txt"), recording.keys)
    elif labels is not None and recording.format in ("kitti_tracking", "rgbd_folder"):
        is_number = recording.format == "kitti_tracking"
        known = {str(int(key)) if is_number and key.isdecimal() else normal(key) for key in recording.keys}
        with suppress(FormatError):  # reported where the labels are read
            for name, found in labels_by_frame(recording, labels).items():
                if name not in known and name != NO_FRAME:
                    yield labels, found.objects[0].line if found.objects else None, name
    if isinstance(recording, KittiObject):
        yield from _without_frame((recording.root / "calib").glob("*.txt"), recording.keys)
        yield from _image_sets(recording)
    elif isinstance(recording, SunRgbdExtracted):
        yield from _without_frame((recording.path / "calib").glob("*.txt"), recording.keys)
        for file in sorted(recording.path.glob(INDICES)):
            yield from _not_listed(file, {int(key) for key in recording.keys if key.isdecimal()}, int)
    elif recording.format == "rcv":
        for folder in FOLDERS:
            yield from _without_frame((recording.path / folder).glob("*"), recording.keys)
        for file in sorted((recording.path / SPLITS).glob("*.txt")):
            yield from _not_listed(file, map(normal, recording.keys))


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
