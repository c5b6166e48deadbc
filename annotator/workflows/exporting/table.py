"""The table of export formats. A new format needs one row here and a function in `formats_3d.py` or `pictures.py`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from annotator.project import REVIEWED
from annotator.types import ReviewState
from annotator.workflows.exporting import formats_3d, pictures
from annotator.workflows.exporting.choose import NOT_REJECTED
from annotator.workflows.exporting.job import ExportJob, ExportReport


class ExportFormat(StrEnum):
    """Export formats."""

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


@dataclass(frozen=True)
class Writer:
    """How a format is written.

    Attributes:
        summary: a short description to display.
        states: default review states of exported labels: reviewed ones, or all but rejected ones if the format stores
            the state.
        write: writes the dataset atomically.
        flat: True for formats of 2D boxes on images, which need no 3D label (`choose_pictures.py`).
    """

    summary: str
    states: tuple[ReviewState, ...]
    write: Callable[[ExportJob], ExportReport]
    flat: bool = False


WRITERS: dict[ExportFormat, Writer] = {
    ExportFormat.RCV: Writer(
        "images, coloured PLY clouds and fully oriented boxes", NOT_REJECTED, formats_3d.rcv_dataset
    ),
    ExportFormat.KITTI: Writer(
        "a KITTI object folder: training, ImageSets; upright boxes", REVIEWED, formats_3d.kitti_folder
    ),
    ExportFormat.KITTI_TRACKING: Writer(
        "KITTI tracking sequences, one per recording; upright boxes with track ids",
        REVIEWED,
        formats_3d.kitti_tracking_folder,
    ),
    ExportFormat.SUNRGBD: Writer(
        "SUN RGB-D in VoteNet's layout, with the data set's own label table", REVIEWED, formats_3d.sunrgbd_folder
    ),
    ExportFormat.COCO: Writer("2D boxes on camera images and pseudo-views", REVIEWED, pictures.coco_dataset, flat=True),
    ExportFormat.YOLO: Writer(
        "2D boxes on camera images and pseudo-views, for Ultralytics", REVIEWED, pictures.yolo_dataset, flat=True
    ),
    ExportFormat.OPENLABEL: Writer(
        "ASAM OpenLABEL documents; fully oriented boxes", NOT_REJECTED, formats_3d.openlabel_documents
    ),
    ExportFormat.LABELCLOUD: Writer(
        "a labelCloud project; fully oriented boxes", REVIEWED, formats_3d.labelcloud_project
    ),
    ExportFormat.NUSCENES: Writer("nuScenes tables; fully oriented boxes", REVIEWED, formats_3d.nuscenes_tables),
    ExportFormat.SUSTECHPOINTS: Writer(
        "SUSTechPOINTS' scenes; fully oriented boxes with track ids", REVIEWED, formats_3d.sustechpoints_scenes
    ),
}
