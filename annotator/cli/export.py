"""`annotator export`"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from annotator.cli.options import AsJson, RecordingNames, Seed, ids_of, names_in
from annotator.cli.output import counted, print_result
from annotator.formats.table import with_option
from annotator.project import Project
from annotator.types import ReviewState
from annotator.types.errors import ConfigError
from annotator.workflows import exporting
from annotator.workflows.exporting.choose import Pictures


def run(
    project: Project,
    out: Path,
    /,
    *,
    format: exporting.ExportFormat = exporting.ExportFormat.RCV,
    states: tuple[ReviewState, ...] = (),
    classes: tuple[str, ...] = (),
    recordings: RecordingNames = (),
    empty_frames: bool = False,
    skip_unreadable: bool = False,
    split: str | None = None,
    split_by: exporting.SplitBy = exporting.SplitBy.FRAMES,
    seed: Seed = 0,
    images: Literal["png", "jpg"] = "png",
    boxes_on: Pictures = "images",
    vertices: bool = False,
    overwrite: bool = False,
    as_json: AsJson = False,
) -> None:
    """Write the labels with their images and point clouds as a dataset. If the export fails, its files are removed.

    Args:
        out: new folder for the dataset.
        format: {formats}.
        states: review states of the labels to export; default: accepted and edited; with rcv and openlabel, which
            store the state of each label: all but rejected.
        classes: classes of the labels to export, with spaces or commas between them; default: all.
        empty_frames: include frames that have no label to export.
        skip_unreadable: skip frames that cannot be read, and list them.
        split: parts of the dataset and their shares of the frames, such as train=0.8,val=0.2; default: no split.
        split_by: frames = assign each frame to a part; recordings = keep the frames of a recording in one part.
        images: file format of the images; png is lossless.
        boxes_on: with {boxes-on}: 2D boxes on camera images, on pseudo-views, or on both.
        vertices: with {vertices}: write the 8 corners of each box instead of centre, size and angles.
        overwrite: replace an existing dataset at OUT.
    """
    parts = None if split is None else exporting.Split(exporting.parse_shares(split), split_by, seed)
    if parts is None and split_by is not exporting.SplitBy.FRAMES:
        raise ConfigError("--split-by needs --split")
    wanted, ids = names_in(classes, project.config.classes) or None, ids_of(project, recordings)
    choose = exporting.ExportFilter(states or None, wanted, ids, empty_frames, skip_unreadable)
    options = exporting.ExportOptions(images, boxes_on, vertices)
    with counted(f"export {format}") as progress:
        report = exporting.export_project(
            project, out, format, choose=choose, split=parts, options=options, overwrite=overwrite, progress=progress
        )
    print_result(report, _lines(report), as_json)


def _lines(report: exporting.ExportReport) -> Iterator[str]:
    counts = ", ".join(f"{number} {name}" for name, number in report.objects_by_class.items())
    what = "images" if exporting.WRITERS[exporting.ExportFormat(report.format)].flat else "frames"
    yield f"{report.out}: {report.frames} {what}, {counts}"
    if report.splits:
        yield "split: " + ", ".join(f"{name} {number}" for name, number in report.splits.items())
    yield from (f"lost in {report.format}: {loss.message}" for loss in report.losses)
    yield from (f"unreadable: {line}" for line in report.unreadable)
    yield from report.notes


_SUMMARIES = "; ".join(f"{name} = {writer.summary.replace(';', ',')}" for name, writer in exporting.WRITERS.items())
run.__doc__ = (run.__doc__ or "").replace("{formats}", _SUMMARIES)
for _option in ("boxes-on", "vertices"):
    run.__doc__ = run.__doc__.replace(f"{{{_option}}}", with_option(_option))
