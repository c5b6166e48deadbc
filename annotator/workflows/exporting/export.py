"""Exports a project: chooses the frames, leaves out unreadable ones if requested, and writes the dataset."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from annotator.formats.losses import Losses, Lost
from annotator.project import Project
from annotator.types.errors import FrameError
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
from annotator.workflows.exporting.table import WRITERS, ExportFormat
from annotator.workflows.frame_source import FrameSource

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

    Raises:
        ConfigError: no label (or image) fits the filter, or the frames cannot be divided as requested.
        FormatError: `out` exists or cannot be written.
        RecordingError: a frame cannot be read and such frames are not skipped, or no frame can be read.
    """
    choose, options, writer, losses = choose or ExportFilter(), options or ExportOptions(), WRITERS[format], Losses()
    states = choose.states or writer.states
    chosen: Sequence[Chosen]
    note, unreadable = None, tuple[str, ...]()
    if writer.flat:
        chosen = choose_pictures(project, choose, states, split, options.pictures, losses)
    else:
        chosen = choose_frames(project, choose, states, split)
    if choose.skip_unreadable:
        # all frames are read twice: the progress covers both passes, and either can be cancelled
        first, progress = _halves(progress)
        chosen, unreadable = readable_frames(project, chosen, losses, first)
    if not writer.flat:
        note = waiting_note(project, choose, states, chosen)
    report = writer.write(ExportJob(project, out, tuple(chosen), options, overwrite, progress, losses, choose))
    notes = report.notes if note is None else (*report.notes, note)
    return report.model_copy(update={"notes": notes, "unreadable": unreadable})


def _halves(progress: Progress | None) -> tuple[Progress | None, Progress | None]:
    """Returns the progress functions of the first pass (reading) and the second pass (writing)."""
    if progress is None:
        return None, None
    return lambda done, total: progress(done, 2 * total), lambda done, total: progress(total + done, 2 * total)


def readable_frames(
    project: Project, chosen: Sequence[Chosen], losses: Losses, progress: Progress | None = None
) -> tuple[list[Chosen], tuple[str, ...]]:
    """Returns the frames that can be read, and the others as `RECORDING/KEY: reason`.

    Every frame is read once in advance, because writers name and number frames before they read them. Pseudo-views of
    an unreadable frame are still exported, because the project stores them.

    Args:
        losses: counts the frames that are left out.
        progress: called with (frames read, frames to read).

    Raises:
        FrameError: no frame can be read; the error of the first one.
        RecordingError: a recording has been moved.
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
