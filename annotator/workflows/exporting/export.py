"""Exports a project: chooses the frames, leaves out unreadable ones if requested, and writes the dataset."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from annotator import __version__
from annotator.formats.dataset_writing import DatasetInfo, Detector, write_dataset
from annotator.formats.losses import Losses
from annotator.formats.table import FORMATS, ExportFormat
from annotator.project import Project
from annotator.types.errors import ConfigError
from annotator.workflows.detectors import base_titles, lifted_from
from annotator.workflows.exporting.choose import (
    Chosen,
    ExportFilter,
    Split,
    choose_frames,
    choose_pictures,
    waiting_note,
)
from annotator.workflows.exporting.job import ExportJob, ExportOptions, ExportReport
from annotator.workflows.exporting.pictures import write_pictures

UNREGISTERED = "unregistered"


def write_boxes(job: ExportJob) -> ExportReport:
    """Writes a dataset of 3D boxes."""
    project, options = job.project, job.options
    recordings = {chosen.recording: chosen.stored.recording_id for chosen in job.chosen}
    is_tracking = job.format is ExportFormat.KITTI_TRACKING
    if is_tracking:
        _require_sequences(job, recordings)
    info = DatasetInfo(
        classes=job.classes,
        generator=f"annotator {__version__}",
        image_format=options.image_format,
        vertices=options.vertices,
        detectors=_detectors(job),
        places=[(each.recording, each.stored.key, each.stored.index or 0) for each in job.chosen],
        free_tracks={name: project.labels.next_track_id(id) for name, id in recordings.items()} if is_tracking else {},
    )
    written = write_dataset(FORMATS[job.format], job.out, job.items(), info, job.losses, overwrite=job.overwrite)
    return job.report(dict(written.counts), [origin.split for origin in written.origins], written.notes)


def _detectors(job: ExportJob) -> tuple[Detector, ...]:
    """Returns the detectors that proposed these labels, in the order of their runs, and those that suggested them."""
    project = job.project
    run_ids = {entry.run_id for chosen in job.chosen for entry in chosen.labels}
    names = {(model.role.value, model.fingerprint): model.path.parent.name for model in project.models.all()}
    detectors = dict.fromkeys(
        used
        for run in project.jobs.all()
        if run.id in run_ids
        for used in (("image", run.image_detector), ("view", run.view_detector))
    )
    titles = base_titles(project)
    for run in project.jobs.all():
        if run.id in titles:
            names["view", run.view_detector] = titles[run.id]
        if origin := lifted_from(run):
            names["image", run.image_detector] = origin
    # other detectors that were not trained in the project (as in the benchmarks) have no name
    for suggestion in [entry.label.suggestion for chosen in job.chosen for entry in chosen.labels]:
        if suggestion is not None:
            names.setdefault(("view", suggestion.fingerprint), suggestion.detector)
            detectors.setdefault(("view", suggestion.fingerprint))
    return tuple(Detector(role=r, name=names.get((r, f), UNREGISTERED), fingerprint=f) for r, f in detectors)


def _require_sequences(job: ExportJob, recordings: dict[str, int]) -> None:
    parts: dict[str, set[str | None]] = {}
    for chosen in job.chosen:
        parts.setdefault(chosen.recording, set()).add(chosen.split)
    for name, recording_id in recordings.items():
        if not job.project.recordings.get(recording_id).is_sequence:
            raise ConfigError(
                f"the frames of {name} are not a sequence; export it as kitti, or choose the other recordings with "
                "--recordings"
            )
        if len(parts[name]) > 1:
            raise ConfigError(f"a sequence cannot be divided, and {name} is in several parts; divide by recording")


Progress = Callable[[int, int], None]


def export_project(
    project: Project,
    out: Path,
    format: ExportFormat = ExportFormat.RCV,
    *,
    choose: ExportFilter | None = None,
    split: Split | None = None,
    options: ExportOptions | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> ExportReport:
    """Writes the chosen labels with their images and clouds to `out`, atomically.

    Args:
        split: how the dataset is divided into parts; None = one part.
        progress: called with (frames done, frames to write).
    """
    choose, options, writer, losses = choose or ExportFilter(), options or ExportOptions(), FORMATS[format], Losses()
    states = choose.states or writer.states
    chosen: Sequence[Chosen]
    if writer.flat:
        chosen = choose_pictures(project, choose, states, split, options.pictures, losses)
    else:
        chosen = choose_frames(project, choose, states, split)
    job = ExportJob(project, format, out, tuple(chosen), options, overwrite, progress, losses, choose)
    if writer.flat:
        return write_pictures(job)
    report = write_boxes(job)
    note = waiting_note(project, choose, states, chosen)
    return report if note is None else report.model_copy(update={"notes": (*report.notes, note)})
