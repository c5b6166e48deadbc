"""The table of export formats. A new format needs one line here and one module in this folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from importlib import import_module

from annotator.project import REVIEWED
from annotator.types import ReviewState
from annotator.workflows.exporting.job import ExportJob
from annotator.workflows.exporting.report import ExportReport

NOT_REJECTED = (ReviewState.PROPOSED, *REVIEWED)


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


@dataclass(frozen=True)
class Writer:
    """How a format is written.

    Attributes:
        summary: a short description to display.
        states: default review states of exported labels: reviewed ones, or all but rejected ones if the format stores
            the state.
        module: module in this folder with a function `write(job: ExportJob) -> ExportReport`.
        flat: True for formats of 2D boxes on images, which need no 3D label (`choose_pictures.py`).
    """

    summary: str
    states: tuple[ReviewState, ...]
    module: str
    flat: bool = False

    def write(self, job: ExportJob) -> ExportReport:
        """Writes the dataset atomically."""
        function: Callable[[ExportJob], ExportReport] = import_module(
            f"annotator.workflows.exporting.{self.module}"
        ).write
        return function(job)


WRITERS: dict[ExportFormat, Writer] = {
    ExportFormat.RCV: Writer("images, coloured PLY clouds and fully oriented boxes", NOT_REJECTED, "rcv"),
    ExportFormat.KITTI: Writer("a KITTI object folder: training, ImageSets; upright boxes", REVIEWED, "kitti"),
    ExportFormat.KITTI_TRACKING: Writer(
        "KITTI tracking sequences, one per recording; upright boxes with track ids", REVIEWED, "kitti_tracking"
    ),
    ExportFormat.SUNRGBD: Writer(
        "SUN RGB-D in VoteNet's layout, with the data set's own label table", REVIEWED, "sunrgbd"
    ),
    ExportFormat.COCO: Writer("2D boxes on camera images and pseudo-views", REVIEWED, "coco", flat=True),
    ExportFormat.YOLO: Writer(
        "2D boxes on camera images and pseudo-views, for Ultralytics", REVIEWED, "yolo", flat=True
    ),
    ExportFormat.OPENLABEL: Writer("ASAM OpenLABEL documents; fully oriented boxes", NOT_REJECTED, "openlabel"),
    ExportFormat.LABELCLOUD: Writer("a labelCloud project; fully oriented boxes", REVIEWED, "labelcloud"),
    ExportFormat.NUSCENES: Writer("nuScenes tables; fully oriented boxes", REVIEWED, "nuscenes"),
}
