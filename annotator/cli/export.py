"""`annotator export`"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path

from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.cli.projects import Root, open_named
from annotator.formats.rcv import RcvOptions
from annotator.types import ReviewState
from annotator.workflows.export import DEFAULT_STATES, ExportFilter, export_dataset


class Format(StrEnum):
    """Formats that labels can leave in."""

    RCV = "rcv"


class ImageFormat(StrEnum):
    """How camera images are written."""

    PNG = "png"
    JPG = "jpg"


def run(
    project: str,
    out: Path,
    /,
    *,
    format: Format = Format.RCV,
    states: tuple[ReviewState, ...] = DEFAULT_STATES,
    classes: tuple[str, ...] = (),
    recordings: tuple[str, ...] = (),
    empty_frames: bool = False,
    images: ImageFormat = ImageFormat.PNG,
    overwrite: bool = False,
    root: Root = None,
) -> None:
    """Write the labels with their images and point clouds as a dataset. Complete, or not at all.

    Args:
        project: the project's name.
        out: the new folder.
        format: rcv = images, coloured PLY clouds and fully oriented boxes, after 3D_HUMAN and 3D_HAND.
        states: which labels, by their state in the review; each leaves with its state written beside it.
        classes: which labels, by class; default: all.
        recordings: names of the recordings; default: all.
        empty_frames: also frames without any such label.
        images: png is lossless.
        overwrite: replace a dataset that is at `out` already.
        root: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
    """
    with open_named(project, root) as opened, counted(f"export {format}") as progress:
        ids = tuple(opened.recordings.find(name).id for name in recordings) or None
        choose = ExportFilter(states, classes or None, ids, empty_frames)
        options = RcvOptions(image_format=images.value)
        written = export_dataset(opened, out, choose=choose, options=options, overwrite=overwrite, progress=progress)
    counts = ", ".join(f"{number} {name}" for name, number in written.counts.objects_by_class.items())
    print_line(f"{out}: {written.counts.frames} frames, {counts}")
