"""2D boxes as a YOLO detection dataset."""

from __future__ import annotations

from annotator.formats.yolo_dataset import YoloWriter, is_yolo_dataset
from annotator.workflows.exporting.job import ExportJob
from annotator.workflows.exporting.pictures import write_pictures
from annotator.workflows.exporting.report import ExportReport

UNDIVIDED = "without parts: the same images are used for training and validation; divide with --split train=0.8,val=0.2"


def write(job: ExportJob) -> ExportReport:
    """Raises as `write_pictures`; ConfigError: parts other than train, val and test."""
    report = write_pictures(job, "yolo", YoloWriter, is_yolo_dataset)
    return report if report.splits else report.model_copy(update={"notes": (UNDIVIDED,)})
