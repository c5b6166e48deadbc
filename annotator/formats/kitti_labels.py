"""KITTI labels of many frames at once: a `label_2` folder, the dataset around it, or a tracking file.

The boxes are in rectified camera 0, as in `kitti.py`. A `frames.csv` above the label files (which our exports have)
says what each file's frame is called in a project; without it the file's name is the frame's key.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from annotator.formats.kitti import DONT_CARE, KittiLabel, parse_fields, parse_tracking_fields, row_truth
from annotator.formats.kitti_shifts import LABELS, calibration_beside, read_shift
from annotator.formats.numbered import Meanings
from annotator.formats.text_folder import text_files, text_rows
from annotator.types import Truth
from annotator.types.errors import FormatError

PLACES = ("training/label_2", "label_2", "label_02.txt")

Frames = dict[str, tuple[Truth, ...]]
"""The objects of each labelled frame, in rectified camera 0, by `RECORDING/KEY` or only `KEY`."""


def read_kitti_labels(path: Path) -> Frames:
    """The objects of all frames, in file order, DontCare left out.

    Args:
        path: a folder of label files or a zip archive of one, a KITTI folder (training/label_2, label_2), or a tracking
            file `label_02.txt`, where every frame with a row counts as labelled.

    Raises:
        FormatError: there are no labels, a row is none (with its line), or frames.csv lacks a label file.
    """
    place = _place(path)
    if place.is_file() and place.suffix == ".txt":
        return _tracked(place)
    meanings, found = Meanings.of(place), Frames()
    for stem, file, text in text_files(place, within=LABELS):
        lines = ((line, row.split()) for line, row in enumerate(text.splitlines(), 1) if row.strip())
        rows = ((line, parse_fields(fields, file, line)) for line, fields in lines)
        found[meanings.frame(stem)] = _objects(rows, file, meanings)
    return found


def read_kitti_shifts(path: Path) -> dict[str, Float64[np.ndarray, "3"]]:
    """From rectified camera 0 to the colour camera, metres, of the frames whose calibration lies beside their labels.

    Args:
        path: as of `read_kitti_labels`; archives and tracking files have none.

    Raises:
        FormatError: a calibration that is damaged, or frames.csv lacks a label file.
    """
    place = _place(path)
    if not place.is_dir():
        return {}
    meanings = Meanings.of(place)
    files = {file.stem: calibration_beside(file) for file in sorted(place.glob("*.txt")) if file.name[0] != "."}
    return {meanings.frame(stem): read_shift(file) for stem, file in files.items() if file is not None}


def _place(path: Path) -> Path:
    return next((path / name for name in PLACES if (path / name).exists()), path)


def _objects(rows: Iterable[tuple[int, KittiLabel]], file: Path, meanings: Meanings) -> tuple[Truth, ...]:
    truths = [row_truth(row, None, None, file, line) for line, row in rows if row.label != DONT_CARE]
    return tuple(replace(truth, label=meanings.label(truth.label)) for truth in truths)


def _tracked(file: Path) -> Frames:
    """The objects of a tracking file; its frames are named as KITTI names their images."""
    found: dict[str, list[Truth]] = {}
    for line, fields in text_rows(file):
        number, track_id, row = parse_tracking_fields(fields, file, line)
        objects = found.setdefault(f"{number:06d}", [])
        if row.label != DONT_CARE:
            objects.append(row_truth(row, track_id, None, file, line))
    if not found:
        raise FormatError(file, "has no row")
    return {name: tuple(objects) for name, objects in found.items()}
