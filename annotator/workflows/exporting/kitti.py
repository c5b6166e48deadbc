"""Labels as a KITTI object folder."""

from __future__ import annotations

from annotator.formats.kitti_folder import write_kitti
from annotator.formats.numbered import six_digit_ids
from annotator.workflows.exporting.job import ExportJob
from annotator.workflows.exporting.report import ExportReport


def write(job: ExportJob) -> ExportReport:
    """Raises as `write_kitti` and `ExportJob.items`."""
    ids = six_digit_ids([(chosen.recording, chosen.stored.key) for chosen in job.chosen])
    counts = write_kitti(job.out, job.items(), ids, job.classes, job.losses, overwrite=job.overwrite)
    return job.report("kitti", counts)
