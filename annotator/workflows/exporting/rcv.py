"""Labels as a dataset in the `rcv` format, which holds all that the project knows of them."""

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
    """The detectors that proposed these labels, whatever the project uses by now; in the order of their runs."""
    project = job.project
    wanted = {entry.run_id for chosen in job.chosen for entry in chosen.labels}
    names = {(model.role.value, model.fingerprint): model.path.parent.name for model in project.models.all()}
    found = dict.fromkeys(
        used
        for run in project.jobs.all()
        if run.id in wanted
        for used in (("image", run.image_detector), ("view", run.view_detector))
    )
    # a detector that was never trained here (it came with the run, as in the benchmarks) has no name but what it is
    return tuple(RcvDetector(role=r, name=names.get((r, f), UNREGISTERED), fingerprint=f) for r, f in found)
