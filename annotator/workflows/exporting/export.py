"""Exports a project: chooses the frames, leaves out unreadable ones if requested, and writes the dataset."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from annotator import __version__
from annotator.formats.dataset_writing import DatasetInfo, Detector, write_dataset
from annotator.formats.losses import Losses, Lost
from annotator.formats.table import FORMATS, ExportFormat
from annotator.project import Project
from annotator.types.errors import ConfigError, FrameError
from annotator.workflows.detectors import base_titles, lifted_from
from annotator.workflows.exporting.choose import (
    Chosen,
    ChosenPictures,
    ExportFilter,
    Split,
    choose_frames,
    choose_pictures,
    waiting_note,
)
from annotator.workflows.exporting.job import ExportJob, ExportOptions, ExportReport
from annotator.workflows.exporting.pictures import write_pictures
from annotator.workflows.frame_source import FrameSource

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
    return job.report(dict(written.counts), written.notes)


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
        progress: called with (frames written, frames to write); if unreadable frames are skipped, frames count twice.
    """
    choose, options, writer, losses = choose or ExportFilter(), options or ExportOptions(), FORMATS[format], Losses()
    states = choose.states or writer.states
    chosen: Sequence[Chosen]
    note, unreadable = None, tuple[str, ...]()
    if writer.flat:
        chosen = choose_pictures(project, choose, states, split, options.pictures, losses)
    else:
        chosen = choose_frames(project, choose, states, split)
    told = progress
    if choose.skip_unreadable:
        # all frames are read twice: the progress covers both passes, and either can be cancelled
        first = None if progress is None else lambda done, total: progress(done, 2 * total)
        told = None if progress is None else lambda done, total: progress(total + done, 2 * total)
        chosen, unreadable = readable_frames(project, chosen, losses, first)
    if not writer.flat:
        note = waiting_note(project, choose, states, chosen)
    job = ExportJob(project, format, out, tuple(chosen), options, overwrite, told, losses, choose)
    report = write_pictures(job) if writer.flat else write_boxes(job)
    notes = report.notes if note is None else (*report.notes, note)
    return report.model_copy(update={"notes": notes, "unreadable": unreadable})


def readable_frames(
    project: Project, chosen: Sequence[Chosen], losses: Losses, progress: Progress | None = None
) -> tuple[list[Chosen], tuple[str, ...]]:
    """Returns the frames that can be read, and the others as `RECORDING/KEY: reason`.

    Every frame is read once in advance, because writers name and number frames before they read them. Pseudo-views of
    an unreadable frame are still exported, because the project stores them.

    Args:
        progress: called with (frames read, frames to read).
    """
    source, left_out = FrameSource(project), []
    readable: list[Chosen] = []
    first: FrameError | None = None
    for number, each in enumerate(chosen, 1):
        views_alone = isinstance(each, ChosenPictures) and not each.image
        try:
            if not views_alone:
                source.read(each.stored)
        except FrameError as error:
            first = first or error
            left_out.append(f"{each.recording}/{each.stored.key}: {error}")
            if isinstance(each, ChosenPictures) and each.views:
                readable.append(replace(each, image=False))
        else:
            readable.append(each)
        if progress is not None:
            progress(number, len(chosen))
    if first is not None and not readable:
        raise first
    losses.add(Lost.UNREADABLE, len(left_out))
    return readable, tuple(left_out)
