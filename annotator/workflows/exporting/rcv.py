"""Labels as a dataset in the `rcv` format, which stores all of their data."""

from __future__ import annotations

from annotator import __version__
from annotator.formats.rcv import RcvDetector, RcvInfo, RcvOptions, export_rcv
from annotator.workflows.exporting.job import ExportJob
from annotator.workflows.exporting.report import ExportReport

UNREGISTERED = "unregistered"


def write(job: ExportJob) -> ExportReport:
    """Raises as `export_rcv` and `ExportJob.items`."""
    info = RcvInfo(
        classes=job.classes,
        detectors=_detectors(job),
        generator=f"annotator {__version__}",
        options=RcvOptions(image_format=job.options.image_format),
    )
    manifest = export_rcv(job.out, job.items(), info, overwrite=job.overwrite)
    return job.report("rcv", manifest.counts.objects_by_class)


def _detectors(job: ExportJob) -> tuple[RcvDetector, ...]:
    """Returns the detectors that proposed these labels, in the order of their runs."""
    project = job.project
    run_ids = {entry.run_id for chosen in job.chosen for entry in chosen.labels}
    names = {(model.role.value, model.fingerprint): model.path.parent.name for model in project.models.all()}
    detectors = dict.fromkeys(
        used
        for run in project.jobs.all()
        if run.id in run_ids
        for used in (("image", run.image_detector), ("view", run.view_detector))
    )
    # detectors that were not trained in the project (as in the benchmarks) have no name
    return tuple(RcvDetector(role=r, name=names.get((r, f), UNREGISTERED), fingerprint=f) for r, f in detectors)
