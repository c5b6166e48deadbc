"""The table of label formats. A new format is a module and a row here.

The rows drive `annotator export` and its help, the page, the table of docs/formats.md (its test makes it), the tests of
round trips, and what imports and checks recognise (`recognising`). The readers of a format are functions of its module,
which return `LabelledFrame`s or `PictureLabels`; `annotator.workflows.importing` places these on a project's frames.
"""

from __future__ import annotations

from enum import StrEnum

from annotator.formats import (
    argoverse,
    boxes_json,
    coco,
    kitti_objects,
    kitti_tracking,
    labelcloud,
    nuscenes_tables,
    openlabel,
    rcv,
    sunrgbd,
    sustechpoints,
    yolo,
)
from annotator.formats.attributes import OCCLUSION, TRUNCATION
from annotator.formats.dataset_writing import Format
from annotator.formats.losses import Lost

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
        marks=kitti_objects.PLACES,
        writer=kitti_objects.KittiWriter,
        areas=True,
        angles=True,
    ),
    "kitti-tracking": Format(
        "KITTI tracking sequences, one per recording; upright boxes with track ids",
        "upright",
        loses=KITTI_LOSES,
        values=(TRUNCATION, OCCLUSION),
        marks=(f"training/{kitti_tracking.TRACK_LABELS}/", f"{kitti_tracking.TRACK_LABELS}/"),
        writer=kitti_tracking.KittiTrackingWriter,
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
        writer=nuscenes_tables.NuScenesWriter,
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
    "boxes": Format("", "any rotation", loses=(Lost.STATE, Lost.SAID, Lost.ORIGIN), marks=boxes_json.PLACES),
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
