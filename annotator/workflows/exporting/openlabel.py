"""Labels as OpenLABEL documents, which store each box's rotation, track, score, state and author."""

from __future__ import annotations

from annotator import __version__
from annotator.formats.openlabel import write_openlabel
from annotator.workflows.exporting.job import ExportJob
from annotator.workflows.exporting.report import ExportReport


def write(job: ExportJob) -> ExportReport:
    """Raises as `write_openlabel` and `ExportJob.items`."""
    objects = write_openlabel(
        job.out,
        job.items(),
        f"annotator {__version__}",
        job.options.image_format,
        losses=job.losses,
        overwrite=job.overwrite,
    )
    return job.report("openlabel", dict(objects))
