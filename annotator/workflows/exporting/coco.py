"""2D boxes as a COCO detection dataset."""

from __future__ import annotations

from annotator.formats.coco_dataset import CocoWriter, is_coco_dataset
from annotator.workflows.exporting.job import ExportJob
from annotator.workflows.exporting.pictures import write_pictures
from annotator.workflows.exporting.report import ExportReport


def write(job: ExportJob) -> ExportReport:
    """Raises as `write_pictures`."""
    return write_pictures(job, "coco", CocoWriter, is_coco_dataset)
