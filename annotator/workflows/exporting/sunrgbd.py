"""Labels as SUN RGB-D, in the layout that VoteNet extracts."""

from __future__ import annotations

from annotator.formats.frame_class_names import six_digit_ids
from annotator.formats.sunrgbd.folder import write_sunrgbd
from annotator.workflows.exporting.job import ExportJob
from annotator.workflows.exporting.report import ExportReport

# The data set counts its frames from 1.
FIRST = 1


def write(job: ExportJob) -> ExportReport:
    """Raises as `write_sunrgbd` and `ExportJob.items`."""
    ids = six_digit_ids([(chosen.recording, chosen.stored.key) for chosen in job.chosen], FIRST)
    counts = write_sunrgbd(job.out, job.items(), ids, job.classes, job.losses, overwrite=job.overwrite)
    return job.report("sunrgbd", counts)
