"""`annotator export`"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path

from annotator.cli.output import AsJson, print_json, print_line
from annotator.cli.progress import counted
from annotator.cli.projects import Root, open_named
from annotator.types import ReviewState
from annotator.types.errors import ConfigError
from annotator.workflows.exporting import (
    WRITERS,
    ExportFilter,
    ExportFormat,
    ExportOptions,
    ExportReport,
    Split,
    SplitBy,
    export_project,
    parse_shares,
)


class ImageFormat(StrEnum):
    """How camera images are written."""

    PNG = "png"
    JPG = "jpg"


class Pictures(StrEnum):
    """What formats of 2D boxes hold."""

    IMAGES = "images"
    VIEWS = "views"
    BOTH = "both"


def run(
    project: str,
    out: Path,
    /,
    *,
    format: ExportFormat = ExportFormat.RCV,
    states: tuple[ReviewState, ...] = (),
    classes: tuple[str, ...] = (),
    recordings: tuple[str, ...] = (),
    empty_frames: bool = False,
    skip_unreadable: bool = False,
    split: str | None = None,
    split_by: SplitBy = SplitBy.FRAMES,
    seed: int = 0,
    images: ImageFormat = ImageFormat.PNG,
    pictures: Pictures = Pictures.IMAGES,
    vertices: bool = False,
    overwrite: bool = False,
    as_json: AsJson = False,
    root: Root = None,
) -> None:
    """Write the labels with their images and point clouds as a dataset. Complete, or not at all.

    Args:
        project: the project's name.
        out: the new folder.
        format: {formats}.
        states: which labels, by their state in the review; default: accepted and edited ones, and with rcv and
            openlabel, which write each label's state beside it, all but rejected ones.
        classes: which labels, by class; default: all.
        recordings: names of the recordings; default: all.
        empty_frames: also frames without any such label.
        skip_unreadable: leave out frames that cannot be read, and say which; every frame is read twice then.
        split: divide the frames into parts, by shares: train=0.8,val=0.2.
        split_by: recordings = no recording is divided.
        seed: of the dividing.
        images: png is lossless.
        pictures: coco and yolo: 2D boxes on camera images, on pseudo-views, or on both.
        vertices: labelcloud: the 8 corners of each box instead of centre, size and angles.
        overwrite: replace a dataset that is at `out` already.
        as_json: print one JSON object.
        root: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
    """
    parts = None if split is None else Split(parse_shares(split), split_by, seed)
    if parts is None and split_by is not SplitBy.FRAMES:
        raise ConfigError("--split-by says what --split may not divide; give --split, too")
    with open_named(project, root) as opened, counted(f"export {format}") as progress:
        ids = tuple(opened.recordings.find(name).id for name in recordings) or None
        report = export_project(
            opened,
            out,
            format,
            choose=ExportFilter(states or None, classes or None, ids, empty_frames, skip_unreadable),
            split=parts,
            options=ExportOptions(images.value, pictures.value, vertices),
            overwrite=overwrite,
            progress=progress,
        )
    if as_json:
        print_json(report)
    else:
        _tell(report)


def _tell(report: ExportReport) -> None:
    counts = ", ".join(f"{number} {name}" for name, number in report.objects_by_class.items())
    what = "pictures" if WRITERS[ExportFormat(report.format)].flat else "frames"
    print_line(f"{report.out}: {report.frames} {what}, {counts}")
    if report.splits:
        print_line("divided: " + ", ".join(f"{name} {number}" for name, number in report.splits.items()))
    for loss in report.losses:
        print_line(f"{report.format} does not hold: {loss.message}")
    for line in report.unreadable:
        print_line(f"unreadable: {line}")
    for note in report.notes:
        print_line(note)


run.__doc__ = (run.__doc__ or "").replace(
    "{formats}", "; ".join(f"{name} = {writer.summary}" for name, writer in WRITERS.items())
)
