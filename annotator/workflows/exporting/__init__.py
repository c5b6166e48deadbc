"""Exports the labels of a project as a dataset in one of the formats of `table.py`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from annotator.formats.losses import Losses
from annotator.project import Project
from annotator.workflows.exporting.choose import Chosen, ExportFilter, choose_frames, waiting_note
from annotator.workflows.exporting.choose_pictures import choose_pictures
from annotator.workflows.exporting.job import ExportJob, ExportOptions
from annotator.workflows.exporting.readable import readable_frames
from annotator.workflows.exporting.report import ExportReport
from annotator.workflows.exporting.split import Split, SplitBy, parse_shares
from annotator.workflows.exporting.table import WRITERS, ExportFormat

__all__ = [
    "WRITERS",
    "ExportFilter",
    "ExportFormat",
    "ExportOptions",
    "ExportReport",
    "Split",
    "SplitBy",
    "export_project",
    "parse_shares",
]


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


Progress = Callable[[int, int], None]


def _halves(progress: Progress | None) -> tuple[Progress | None, Progress | None]:
    """Returns the progress functions of the first pass (reading) and the second pass (writing)."""
    if progress is None:
        return None, None
    return lambda done, total: progress(done, 2 * total), lambda done, total: progress(total + done, 2 * total)
