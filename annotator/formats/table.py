"""The table of label formats. A new format is a module and a row here.

The rows drive `annotator export` and its help, the page, the table of docs/formats.md (its test makes it), the tests of
round trips, and what imports and checks recognise: a folder by its marks, a file by its content. The readers of a
format are functions of its module, which return `LabelledFrame`s or `PictureLabels`;
`annotator.workflows.importing` places these on a project's frames.
"""

from __future__ import annotations

import re
from codecs import BOM_UTF8
from contextlib import suppress
from enum import StrEnum
from itertools import islice
from pathlib import Path

from pydantic_core import from_json

from annotator.files import open_file, why_missing
from annotator.formats import (
    argoverse,
    box_files,
    coco,
    kitti_folders,
    labelcloud,
    nuscenes,
    openlabel,
    rcv,
    sunrgbd,
    sustechpoints,
    yolo,
)
from annotator.formats.box_files import is_box_csv
from annotator.formats.dataset_writing import Format, Lost
from annotator.formats.frame_names import OCCLUSION, TRUNCATION
from annotator.formats.reading import read_json, text_files, text_rows
from annotator.types.errors import FormatError

KITTI_LOSES = (Lost.SCORE, Lost.STATE, Lost.SAID, Lost.LENS, Lost.DEPTH_COLOR, Lost.TIME, Lost.GRAVITY, Lost.ORIGIN)
FLAT_LOSES = (Lost.SCORE, Lost.TRACK, Lost.STATE, Lost.TIME, Lost.ORIGIN)
LABELCLOUD = (labelcloud.CLASSES_FILE, f"{labelcloud.LABELS}/{labelcloud.CLASSES_FILE}")

# By the names that commands and the page have for them; annotator's own first.
FORMATS: dict[str, Format] = {
    "rcv": Format(
        "images, coloured PLY clouds and fully oriented boxes",
        "any rotation",
        of_frames=True,
        marks=(rcv.MANIFEST,),
        is_ours=rcv.is_rcv_export,
        writer=rcv.RcvWriter,
        frames_csv=False,
        options=("images",),
    ),
    "kitti": Format(
        "a KITTI object folder: training, ImageSets; upright boxes",
        "upright",
        loses=(*KITTI_LOSES, Lost.TRACK),
        values=(TRUNCATION, OCCLUSION),
        marks=kitti_folders.PLACES,
        writer=kitti_folders.KittiWriter,
        areas=True,
        angles=True,
    ),
    "kitti-tracking": Format(
        "KITTI tracking sequences, one per recording; upright boxes with track ids",
        "upright",
        loses=KITTI_LOSES,
        values=(TRUNCATION, OCCLUSION),
        marks=(f"training/{kitti_folders.TRACK_LABELS}/", f"{kitti_folders.TRACK_LABELS}/"),
        writer=kitti_folders.KittiTrackingWriter,
        areas=True,
        angles=True,
    ),
    "sunrgbd": Format(
        "SUN RGB-D in VoteNet's layout, with the data set's own label table",
        "upright",
        loses=(
            *(Lost.SCORE, Lost.TRACK, Lost.STATE, Lost.SAID, Lost.LENS, Lost.REFLECTANCE, Lost.TIME, Lost.ORIGIN),
            Lost.LEVEL,
        ),
        values=(),
        marks=("SUNRGBDMeta*.mat", "label/*.txt"),
        writer=sunrgbd.SunRgbdWriter,
    ),
    "coco": Format(
        "2D boxes on camera images and pseudo-views",
        "2D",
        loses=FLAT_LOSES,
        of_frames=True,
        marks=(f"{coco.ANNOTATIONS}/instances_*.json",),
        pictures=coco.CocoWriter,
        options=("images", "boxes-on"),
    ),
    "yolo": Format(
        "2D boxes on camera images and pseudo-views, for Ultralytics",
        "2D",
        loses=FLAT_LOSES,
        values=(),
        marks=(yolo.DATA_YAML, yolo.CLASSES),
        is_ours=yolo.is_yolo_export,
        pictures=yolo.YoloWriter,
        options=("images", "boxes-on"),
    ),
    "openlabel": Format(
        "ASAM OpenLABEL documents; fully oriented boxes",
        "any rotation",
        loses=(Lost.GRAVITY,),
        of_frames=True,
        is_ours=openlabel.is_openlabel_export,
        writer=openlabel.OpenLabelWriter,
        options=("images",),
        angles=True,
    ),
    "labelcloud": Format(
        "a labelCloud project; fully oriented boxes",
        "any rotation",
        loses=(Lost.SCORE, Lost.TRACK, Lost.STATE, Lost.SAID, Lost.LENS, Lost.TIME, Lost.ORIGIN, Lost.LEVEL),
        values=(),
        marks=(*LABELCLOUD, f"*/{LABELCLOUD[-1]}"),
        writer=labelcloud.LabelCloudWriter,
        options=("images", "vertices"),
        angles=True,
    ),
    "nuscenes": Format(
        "nuScenes tables; fully oriented boxes",
        "any rotation",
        loses=(Lost.SCORE, Lost.STATE, Lost.SAID, Lost.LENS, Lost.DEPTH_COLOR, Lost.LEVEL),
        marks=("sample_annotation.json", "v1.0-*/sample_annotation.json"),
        writer=nuscenes.NuScenesWriter,
        options=("images",),
    ),
    "sustechpoints": Format(
        "SUSTechPOINTS' scenes; fully oriented boxes with track ids",
        "any rotation",
        loses=(Lost.SCORE, Lost.STATE, Lost.SAID, Lost.LENS, Lost.TIME, Lost.LEVEL),
        marks=(f"*/{sustechpoints.LABELS}/*.json", f"*/*/{sustechpoints.LABELS}/*.json"),
        writer=sustechpoints.SustechWriter,
        options=("images",),
        angles=True,
    ),
    "boxes": Format("", "any rotation", loses=(Lost.STATE, Lost.SAID, Lost.ORIGIN), marks=box_files.PLACES),
    "argoverse2": Format(
        "",
        "any rotation",
        loses=(Lost.SCORE, Lost.STATE, Lost.SAID, Lost.ORIGIN),
        values=(),
        marks=(argoverse.ANNOTATIONS,),
    ),
    "box-csv": Format("", "upright", loses=(Lost.TRACK, Lost.STATE, Lost.SAID, Lost.ORIGIN), values=(), angles=True),
}


class ExportFormat(StrEnum):
    """The formats that are written."""

    RCV = "rcv"
    KITTI = "kitti"
    KITTI_TRACKING = "kitti-tracking"
    SUNRGBD = "sunrgbd"
    COCO = "coco"
    YOLO = "yolo"
    OPENLABEL = "openlabel"
    LABELCLOUD = "labelcloud"
    NUSCENES = "nuscenes"
    SUSTECHPOINTS = "sustechpoints"


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


class FlatFormat(StrEnum):
    """Formats of 2D boxes."""

    COCO = "coco"
    YOLO = "yolo"


AnyFormat = FlatFormat | BoxFormat


def named_format(name: str) -> AnyFormat:
    """Returns the format of this name in `FORMATS`."""
    return FlatFormat(name) if FORMATS[name].flat else BoxFormat(name)


WRITERS: dict[ExportFormat, Format] = {format: FORMATS[format] for format in ExportFormat}


def with_option(option: str) -> str:
    """Returns the names of the formats that have an option of exports, as `coco and yolo`."""
    return " and ".join(name for name, format in FORMATS.items() if option in format.options)


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
    # without labels, SUN RGB-D as VoteNet extracts it: its reader says what to do
    is_sunrgbd = all((folder / name).is_dir() for name in ("image", "calib"))
    return marked(folder) or _of_files_in(folder) or ([BoxFormat.SUNRGBD] if is_sunrgbd else [])


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
    if (folder / yolo.DATA_YAML).is_file():
        return True
    # files in other folders may be calibrations, whose numbers can look like YOLO's polygons
    files = (folder / "labels").rglob("*.txt") if (folder / "labels").is_dir() else folder.glob("*.txt")
    for file in islice((each for each in files if each.name != yolo.CLASSES), LOOK_AT):
        # its reader says what is wrong
        with suppress(FormatError):
            if _of_file(file) == [FlatFormat.YOLO]:
                return True
    return False


def _of_files_in(folder: Path) -> list[AnyFormat]:
    """The format of the first files that show it; labelCloud's labels may also be in a folder `labels`."""
    for pattern in ("*.txt", "*.json", "label/*.json", "*/*.json", "*/label/*.json", "*/*/label/*.json"):
        for file in islice(sorted(folder.glob(pattern)), LOOK_AT):
            if file.name not in ("frames.csv", labelcloud.CLASSES_FILE) and (found := _of_file(file)):
                return found
    return []


def _of_file(file: Path) -> list[AnyFormat]:
    match file.suffix.lower():
        case ".mat":
            return [BoxFormat.SUNRGBD]
        case ".yaml":
            return [FlatFormat.YOLO]
        case ".feather" if file.name == argoverse.ANNOTATIONS:
            return [BoxFormat.ARGOVERSE2]
        case ".csv" if is_box_csv(file):
            return [BoxFormat.BOX_CSV]
        case ".json":
            found = _of_json(_beginning(file))
            # an empty file, or one with a fault that its reader names
            return found or ([BoxFormat.BOXES] if file.name == box_files.NAME else [])
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
    if len(fields) == sunrgbd.FIELDS:
        return [BoxFormat.SUNRGBD]
    return [FlatFormat.YOLO] if len(fields) in YOLO_FIELDS and numbers[0] else []


def _is_polygon(fields: list[str]) -> bool:
    """True for the corners of a turned box or a polygon: shares of an image's size."""
    if len(fields) < yolo.LEAST_CORNERS or len(fields) % 2:
        return False
    with suppress(ValueError):
        return all(-yolo.TOLERANCE <= float(field) <= 1 + yolo.TOLERANCE for field in fields)
    return False


def _of_archive(file: Path) -> list[AnyFormat]:
    # it may also hold calibrations
    for _, _, text in islice(text_files(file, kitti_folders.LABELS, kitti_folders.TRACK_LABELS), LOOK_AT):
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
