"""The table of import formats of boxes, and how each is recognised: by what its reader looks for first.

A new format needs one row here and a function in `readers.py`.
"""

from __future__ import annotations

import re
import zipfile
from codecs import BOM_UTF8
from collections.abc import Callable, Iterator
from contextlib import suppress
from enum import StrEnum
from itertools import islice
from pathlib import Path, PurePosixPath

from pydantic_core import from_json

from annotator.files import ARCHIVE_ERRORS, open_archive, open_file, why_missing
from annotator.formats import kitti_objects, kitti_tracking
from annotator.formats.argoverse import ANNOTATIONS as ARGOVERSE_ANNOTATIONS
from annotator.formats.box_csv import is_box_csv
from annotator.formats.boxes_json import NAME, PLACES
from annotator.formats.coco import ANNOTATIONS
from annotator.formats.json_file import read_json
from annotator.formats.labelcloud import CLASSES_FILE, LABELS
from annotator.formats.rcv import MANIFEST
from annotator.formats.reading import text_rows
from annotator.formats.sunrgbd import FIELDS as SUN_FIELDS
from annotator.formats.units import AngleUnit, Lengths
from annotator.formats.yolo import CLASSES, DATA_YAML, LEAST_CORNERS, TOLERANCE
from annotator.text import decoded
from annotator.types.errors import ConfigError, FormatError
from annotator.workflows.importing import readers
from annotator.workflows.importing.label_set import LabelSet
from annotator.workflows.importing.pictures import FlatFormat


class BoxFormat(StrEnum):
    """Formats of 3D boxes."""

    BOXES = "boxes"
    RCV = "rcv"
    KITTI = "kitti"
    KITTI_TRACKING = "kitti-tracking"
    SUNRGBD = "sunrgbd"
    OPENLABEL = "openlabel"
    LABELCLOUD = "labelcloud"
    NUSCENES = "nuscenes"
    SUSTECHPOINTS = "sustechpoints"
    ARGOVERSE2 = "argoverse2"
    BOX_CSV = "box-csv"


READERS: dict[BoxFormat, Callable[[Path], LabelSet]] = {
    BoxFormat.RCV: readers.rcv_labels,
    BoxFormat.SUNRGBD: readers.sunrgbd_labels,
    BoxFormat.NUSCENES: readers.nuscenes_labels,
    BoxFormat.ARGOVERSE2: readers.argoverse_labels,
    BoxFormat.BOXES: readers.boxes_labels,
}
# The formats that write angles, and their readers, which take the unit; None: as the format says.
WITH_ANGLES: dict[BoxFormat, Callable[[Path, AngleUnit | None], LabelSet]] = {
    BoxFormat.KITTI: readers.kitti_labels,
    BoxFormat.KITTI_TRACKING: readers.kitti_tracking_labels,
    BoxFormat.OPENLABEL: readers.openlabel_labels,
    BoxFormat.LABELCLOUD: readers.labelcloud_labels,
    BoxFormat.SUSTECHPOINTS: readers.sustechpoints_labels,
    BoxFormat.BOX_CSV: readers.box_csv_labels,
}


def read_labels(format: BoxFormat, path: Path, angles: AngleUnit | None = None) -> LabelSet:
    """Reads and checks all labels at `path`.

    Args:
        angles: unit of the angles, if it is not what the format says, or if the labels do not show it.

    Raises:
        FormatError: they do not follow the format.
        UnitError: they cannot be in the units that the format has.
        ConfigError: `angles` for a format without angles.
    """
    if format in WITH_ANGLES:
        dataset = WITH_ANGLES[format](path, angles)
    elif angles is not None:
        raise ConfigError(f"{format} has no angles; leave out --angles (it is for {', '.join(WITH_ANGLES)})")
    else:
        dataset = READERS[format](path)
    Lengths(dataset.sizes_m).require(path)
    return dataset


Format = FlatFormat | BoxFormat

# What is read of a large JSON file.
PEEK_BYTES = 2**20
# How many files of a folder are looked at: the first ones may be empty.
LOOK_AT = 50
# Fields of a row: YOLO's boxes; KITTI's labels and results; KITTI's tracks and their results.
YOLO_FIELDS, KITTI_FIELDS, TRACK_FIELDS = (5,), (15, 16), (17, 18)


def format_of(path: Path) -> Format:
    """Returns the format of the boxes at `path`.

    Raises:
        FormatError: there is nothing at `path`, it fits no format, or it fits several.
    """
    missing = why_missing(path)
    if missing is not None:
        raise FormatError(path, missing)
    if path.is_dir():
        fitting = (
            [format for format, fits in _FOLDERS.items() if fits(path)] or _of_files_in(path) or _of_images_in(path)
        )
    else:
        fitting = _of_file(path)
    if len(fitting) == 1:
        return fitting[0]
    every = "|".join((*FlatFormat, *BoxFormat))
    if not fitting:
        raise FormatError(path, f"no format of boxes was recognised; if it has one of these, name it: --format {every}")
    raise FormatError(path, f"could be {' or '.join(fitting)}; choose one with --format")


def _has(*patterns: str) -> Callable[[Path], bool]:
    return lambda folder: any(next(folder.glob(pattern), None) is not None for pattern in patterns)


_FOLDERS: dict[Format, Callable[[Path], bool]] = {
    BoxFormat.RCV: _has(MANIFEST),
    BoxFormat.NUSCENES: _has("sample_annotation.json", "v1.0-*/sample_annotation.json"),
    BoxFormat.LABELCLOUD: _has(CLASSES_FILE, f"{LABELS}/{CLASSES_FILE}", f"*/{LABELS}/{CLASSES_FILE}"),
    BoxFormat.KITTI_TRACKING: _has(f"training/{kitti_tracking.LABELS}/", f"{kitti_tracking.LABELS}/"),
    BoxFormat.KITTI: _has(*kitti_objects.PLACES),
    BoxFormat.SUNRGBD: _has("SUNRGBDMeta*.mat", "label/*.txt"),
    BoxFormat.ARGOVERSE2: _has(ARGOVERSE_ANNOTATIONS),
    BoxFormat.BOXES: _has(*PLACES),
    FlatFormat.COCO: _has(f"{ANNOTATIONS}/instances_*.json"),
    FlatFormat.YOLO: _has(DATA_YAML, CLASSES),
}


def _of_files_in(folder: Path) -> list[Format]:
    """The format of the first files that show it; labelCloud's labels may also be in a folder `labels`."""
    for pattern in ("*.txt", "*.json", "label/*.json", "*/*.json", "*/label/*.json", "*/*/label/*.json"):
        for file in islice(sorted(folder.glob(pattern)), LOOK_AT):
            if file.name not in ("frames.csv", CLASSES_FILE) and (found := _of_file(file)):
                return found
    return []


def _of_images_in(folder: Path) -> list[Format]:
    """SUN RGB-D as VoteNet extracts it, without labels: its reader says what to do."""
    return [BoxFormat.SUNRGBD] if all((folder / name).is_dir() for name in ("image", "calib")) else []


def _of_file(file: Path) -> list[Format]:
    match file.suffix.lower():
        case ".mat":
            return [BoxFormat.SUNRGBD]
        case ".yaml":
            return [FlatFormat.YOLO]
        case ".feather" if file.name == ARGOVERSE_ANNOTATIONS:
            return [BoxFormat.ARGOVERSE2]
        case ".csv" if is_box_csv(file):
            return [BoxFormat.BOX_CSV]
        case ".json":
            found = _of_json(_beginning(file))
            # an empty file, or one with a fault that its reader names
            return found or ([BoxFormat.BOXES] if file.name == NAME else [])
        case ".txt" if file.name == "label_02.txt":
            return [BoxFormat.KITTI]
        case ".txt":
            rows = text_rows(file)
            return _of_row(rows[0][1]) if rows else []
        case ".zip":
            return _of_archive(file)
    return []


def _of_row(fields: list[str]) -> list[Format]:
    numbers = [re.fullmatch(r"-?\d+", field) is not None for field in fields[:2]]
    if numbers[:1] == [True] and _is_polygon(fields[1:]):
        return [FlatFormat.YOLO]
    if len(fields) in TRACK_FIELDS and all(numbers):
        return [BoxFormat.KITTI_TRACKING]
    if len(fields) in KITTI_FIELDS:
        return [BoxFormat.KITTI]
    if len(fields) == SUN_FIELDS:
        return [BoxFormat.SUNRGBD]
    return [FlatFormat.YOLO] if len(fields) in YOLO_FIELDS and numbers[0] else []


def _is_polygon(fields: list[str]) -> bool:
    """True for the corners of a turned box or a polygon: shares of an image's size."""
    if len(fields) < LEAST_CORNERS or len(fields) % 2:
        return False
    with suppress(ValueError):
        return all(-TOLERANCE <= float(field) <= 1 + TOLERANCE for field in fields)
    return False


def _of_archive(file: Path) -> list[Format]:
    try:
        with open_file(file) as stream, open_archive(stream) as archive:
            for info in _text_members(archive):
                first = decoded(archive.open(info).readline(1000), "replace").split()
                if first:
                    return _of_row(first)
    except ARCHIVE_ERRORS as error:
        raise FormatError(file, f"the archive cannot be read ({error})") from error
    return []


def _text_members(archive: zipfile.ZipFile) -> Iterator[zipfile.ZipInfo]:
    """The label files of an archive first: it may also hold calibrations."""
    members = [info for info in archive.infolist() if info.filename.endswith(".txt") and not info.is_dir()]
    places = (kitti_objects.LABELS, kitti_tracking.LABELS)
    members.sort(key=lambda info: PurePosixPath(info.filename).parent.name not in places)
    return islice(iter(members), LOOK_AT)


def _beginning(file: Path) -> object:
    """The content of a JSON file, up to where its beginning of `PEEK_BYTES` ends."""
    try:
        with open_file(file) as stream:
            return from_json(stream.read(PEEK_BYTES).removeprefix(BOM_UTF8), allow_partial=True)
    except (OSError, ValueError):
        return read_json(file)  # says what is wrong


def _of_json(content: object) -> list[Format]:
    match content:
        case {"results": {}}:
            return [BoxFormat.NUSCENES]
        case {"openlabel": _}:
            return [BoxFormat.OPENLABEL]
        case {"images": [{"file_name": _}, *_]} | {"images": _, "annotations": _} | {"images": _, "categories": _}:
            return [FlatFormat.COCO]
        case [{"psr": _}, *_] | {"objs": [{"psr": _}, *_]}:
            return [BoxFormat.SUSTECHPOINTS]
        case {"objects": _, "filename": _}:
            return [BoxFormat.LABELCLOUD]
        case dict() if any(_is_box(entry) for entries in islice(content.values(), LOOK_AT) for entry in _list(entries)):
            return [BoxFormat.BOXES]
    return []


def _list(entries: object) -> list[object]:
    return entries if isinstance(entries, list) else [entries]


def _is_box(entry: object) -> bool:
    return isinstance(entry, dict) and {"center", "size", "rotation"} <= entry.keys()
