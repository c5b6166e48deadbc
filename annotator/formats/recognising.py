"""Recognises the format of the boxes at a path: a folder by the marks of the table, a file by its content."""

from __future__ import annotations

import re
from codecs import BOM_UTF8
from contextlib import suppress
from itertools import islice
from pathlib import Path

from pydantic_core import from_json

from annotator.files import open_file, why_missing
from annotator.formats import kitti_objects, kitti_tracking
from annotator.formats.argoverse import ANNOTATIONS as ARGOVERSE_ANNOTATIONS
from annotator.formats.box_csv import is_box_csv
from annotator.formats.boxes_json import NAME
from annotator.formats.labelcloud import CLASSES_FILE
from annotator.formats.reading import read_json, text_files, text_rows
from annotator.formats.sunrgbd import FIELDS as SUN_FIELDS
from annotator.formats.table import FORMATS, AnyFormat, BoxFormat, FlatFormat, named_format
from annotator.formats.yolo import CLASSES, DATA_YAML, LEAST_CORNERS, TOLERANCE
from annotator.types.errors import FormatError

# What is read of a large JSON file.
PEEK_BYTES = 2**20
# How many files of a folder are looked at: the first ones may be empty.
LOOK_AT = 50
# Fields of a row: YOLO's boxes; KITTI's labels and results; KITTI's tracks and their results.
YOLO_FIELDS, KITTI_FIELDS, TRACK_FIELDS = (5,), (15, 16), (17, 18)


def format_of(path: Path) -> AnyFormat:
    """Returns the format of the boxes at `path`.

    Raises:
        FormatError: there is nothing at `path`, it fits no format, or it fits several.
    """
    missing = why_missing(path)
    if missing is not None:
        raise FormatError(path, missing)
    fitting = _of_folder(path) if path.is_dir() else _of_file(path)
    if len(fitting) == 1:
        return fitting[0]
    every = "|".join((*FlatFormat, *BoxFormat))
    if not fitting:
        raise FormatError(path, f"no format of boxes was recognised; if it has one of these, name it: --format {every}")
    raise FormatError(path, f"could be {' or '.join(fitting)}; choose one with --format")


def _of_folder(folder: Path) -> list[AnyFormat]:
    return marked(folder) or _of_files_in(folder) or _of_images_in(folder)


def marked(folder: Path) -> list[AnyFormat]:
    """Returns the formats whose marks a folder has.

    `classes.txt` alone is no mark of YOLO where another format fits: exports to formats whose classes are single words
    list the others there. Label files with YOLO's rows show that it is one.
    """
    found = [named_format(name) for name, format in FORMATS.items() if format.is_marked(folder)]
    if len(found) > 1 and FlatFormat.YOLO in found and not _has_yolo_labels(folder):
        found.remove(FlatFormat.YOLO)
    return found


def _has_yolo_labels(folder: Path) -> bool:
    if (folder / DATA_YAML).is_file():
        return True
    # files in other folders may be calibrations, whose numbers can look like YOLO's polygons
    files = (folder / "labels").rglob("*.txt") if (folder / "labels").is_dir() else folder.glob("*.txt")
    for file in islice((each for each in files if each.name != CLASSES), LOOK_AT):
        # its reader says what is wrong
        with suppress(FormatError):
            if _of_file(file) == [FlatFormat.YOLO]:
                return True
    return False


def _of_files_in(folder: Path) -> list[AnyFormat]:
    """The format of the first files that show it; labelCloud's labels may also be in a folder `labels`."""
    for pattern in ("*.txt", "*.json", "label/*.json", "*/*.json", "*/label/*.json", "*/*/label/*.json"):
        for file in islice(sorted(folder.glob(pattern)), LOOK_AT):
            if file.name not in ("frames.csv", CLASSES_FILE) and (found := _of_file(file)):
                return found
    return []


def _of_images_in(folder: Path) -> list[AnyFormat]:
    """SUN RGB-D as VoteNet extracts it, without labels: its reader says what to do."""
    return [BoxFormat.SUNRGBD] if all((folder / name).is_dir() for name in ("image", "calib")) else []


def _of_file(file: Path) -> list[AnyFormat]:
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


def _of_row(fields: list[str]) -> list[AnyFormat]:
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


def _of_archive(file: Path) -> list[AnyFormat]:
    # it may also hold calibrations
    for _, _, text in islice(text_files(file, kitti_objects.LABELS, kitti_tracking.TRACK_LABELS), LOOK_AT):
        if (rows := text_rows(file, text)) and (found := _of_row(rows[0][1])):
            return found
    return []


def _beginning(file: Path) -> object:
    """The content of a JSON file, up to where its beginning of `PEEK_BYTES` ends."""
    try:
        with open_file(file) as stream:
            return from_json(stream.read(PEEK_BYTES).removeprefix(BOM_UTF8), allow_partial=True)
    except (OSError, ValueError):
        return read_json(file)  # says what is wrong


def _of_json(content: object) -> list[AnyFormat]:
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
        case dict() if any(map(_has_box, islice(content.values(), LOOK_AT))):
            return [BoxFormat.BOXES]
    return []


def _has_box(entries: object) -> bool:
    """True for the boxes of a frame in boxes.json: one, or a list."""
    every = entries if isinstance(entries, list) else [entries]
    return any(isinstance(each, dict) and {"center", "size", "rotation"} <= each.keys() for each in every)
