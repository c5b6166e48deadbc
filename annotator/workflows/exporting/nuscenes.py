"""Labels as nuScenes tables."""

from __future__ import annotations

from annotator.formats.nuscenes import write_nuscenes
from annotator.workflows.exporting.job import ExportJob
from annotator.workflows.exporting.report import ExportReport


def write(job: ExportJob) -> ExportReport:
    """Raises as `write_nuscenes` and `ExportJob.items`."""
    objects = write_nuscenes(
        job.out,
        job.items(),
        job.classes,
        job.losses,
        image_format=job.options.image_format,
        overwrite=job.overwrite,
    )
    return job.report("nuscenes", dict(objects))
