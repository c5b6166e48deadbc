"""Finds calibrations and list entries of missing frames, which would stop a training."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from annotator.formats.frame_names import has_frames
from annotator.formats.reading import text_rows
from annotator.recordings import Recording
from annotator.recordings.kitti import KittiObject
from annotator.recordings.listing import IMAGE_SUFFIXES, stems
from annotator.recordings.sunrgbd import SunRgbdExtracted
from annotator.text import normal

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
