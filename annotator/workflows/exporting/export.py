"""Exports a project: chooses the frames, leaves out unreadable ones if requested, and writes the dataset."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from annotator import __version__
from annotator.formats.dataset_writing import DatasetInfo, Detector, write_dataset
from annotator.formats.table import FORMATS, ExportFormat
from annotator.project import Project, StoredLabel
from annotator.types.errors import ConfigError
from annotator.workflows.detectors import base_titles, lifted_from
from annotator.workflows.exporting.choose import (
    Chosen,
    ExportFilter,
    Split,
    choose_frames,
    waiting_note,
)
from annotator.workflows.exporting.job import ExportJob, ExportOptions, ExportReport
from annotator.workflows.exporting.pictures import write_pictures

UNREGISTERED = "unregistered"


def write_boxes(job: ExportJob) -> ExportReport:
    """Writes a dataset of 3D boxes."""
    project, options = job.project, job.options
    frames = choose_frames(project, job.choose, job.states, job.split)
    recordings = {chosen.recording: chosen.stored.recording_id for chosen in frames}
    is_tracking = job.format is ExportFormat.KITTI_TRACKING
    if is_tracking:
        _require_sequences(project, frames)
    info = DatasetInfo(
        classes=project.config.classes,
        generator=f"annotator {__version__}",
        image_format=options.image_format,
        vertices=options.vertices,
        detectors=_detectors(project, [entry for chosen in frames for entry in chosen.labels]),
        places=[(each.recording, each.stored.key, each.stored.index or 0) for each in frames],
        free_tracks={name: project.labels.next_track_id(id) for name, id in recordings.items()} if is_tracking else {},
    )
    written = write_dataset(FORMATS[job.format], job.out, job.items(frames), info, job.losses, overwrite=job.overwrite)
    note = waiting_note(project, job.choose, job.states, frames)
    notes = (*written.notes, *([] if note is None else [note]))
    return job.report(written.counts, [origin.split for origin in written.origins], notes)


def _detectors(project: Project, labels: Sequence[StoredLabel]) -> tuple[Detector, ...]:
    """Returns the detectors that proposed these labels, in the order of their runs, and those that suggested them."""
    run_ids, titles = {entry.run_id for entry in labels}, base_titles(project)
    names = {(model.role.value, model.fingerprint): model.path.parent.name for model in project.models.all()}
    used = dict[tuple[str, str], None]()
    for run in project.jobs.all():
        image, view = ("image", run.image_detector), ("view", run.view_detector)
        used |= {image: None, view: None} if run.id in run_ids else {}
        if run.id in titles:
            names[view] = titles[run.id]
        if origin := lifted_from(run):
            names[image] = origin
    # other detectors that were not trained in the project (as in the benchmarks) have no name
    for entry in labels:
        if (suggestion := entry.label.suggestion) is not None:
            names.setdefault(("view", suggestion.fingerprint), suggestion.detector)
            used.setdefault(("view", suggestion.fingerprint))
    return tuple(Detector(role=r, name=names.get((r, f), UNREGISTERED), fingerprint=f) for r, f in used)


def _require_sequences(project: Project, frames: Sequence[Chosen]) -> None:
    parts: dict[str, str | None] = {}
    for chosen in frames:
        name = chosen.recording
        if name not in parts and not project.recordings.get(chosen.stored.recording_id).is_sequence:
            raise ConfigError(
                f"the frames of {name} are not a sequence; export it as kitti, or choose the other recordings with "
                "--recordings"
            )
        if parts.setdefault(name, chosen.split) != chosen.split:
            raise ConfigError(f"a sequence cannot be divided, and {name} is in several parts; divide by recording")


def export_project(
    project: Project,
    out: Path,
    format: ExportFormat = ExportFormat.RCV,
    *,
    choose: ExportFilter | None = None,
    split: Split | None = None,
    options: ExportOptions | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> ExportReport:
    """Writes the chosen labels with their images and clouds to `out`, atomically; arguments as in `ExportJob`."""
    job = ExportJob(
        project, format, out, choose or ExportFilter(), split, options or ExportOptions(), overwrite, progress
    )
    return write_pictures(job) if FORMATS[format].flat else write_boxes(job)
