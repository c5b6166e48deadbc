"""Labels as a labelCloud project."""

from __future__ import annotations

from annotator import __version__
from annotator.formats.labelcloud import write_labelcloud
from annotator.workflows.exporting.job import ExportJob
from annotator.workflows.exporting.report import ExportReport


def write(job: ExportJob) -> ExportReport:
    """Raises as `write_labelcloud` and `ExportJob.items`."""
    objects = write_labelcloud(
        job.out,
        job.items(),
        job.classes,
        job.losses,
        __version__,
        vertices=job.options.vertices,
        image_format=job.options.image_format,
        overwrite=job.overwrite,
    )
    return job.report("labelcloud", dict(objects))
