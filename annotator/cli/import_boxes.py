"""`annotator import`"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path

from annotator.cli.import_as_2d import import_as_2d
from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.cli.projects import Root, open_named
from annotator.project import Project
from annotator.types import BoxKind
from annotator.types.errors import ConfigError
from annotator.workflows.importing import (
    BoxFormat,
    FlatFormat,
    Renamed,
    import_image_boxes,
    import_labels,
    import_view_boxes,
    read_labels,
)

FLAT = tuple(FlatFormat)
# Every value is known here, so that tyro lists them all in the help.
Format = StrEnum("Format", {name.upper(): name for name in (*FLAT, *BoxFormat)})  # type: ignore[misc]


def run(
    project: str,
    path: Path | None = None,
    /,
    *,
    format: Format = Format.COCO,  # type: ignore[attr-defined]
    pictures: Path | None = None,
    kind: BoxKind = BoxKind.SILHOUETTE,
    recording: str | None = None,
    as_2d: bool = False,
    fraction: float = 1.0,
    seed: int = 0,
    root: Root = None,
) -> None:
    """Take over boxes that were drawn elsewhere: 3D boxes, or 2D boxes on camera images or on pseudo-views.

    3D boxes come to every frame that has no label yet, as accepted labels; with --as-2d they become 2D training boxes
    on the image and on the pseudo-views of the first two steps, and nothing else is kept of them.

    Args:
        project: the project's name.
        path: the file or folder of labels; with --as-2d, those that lie beside the recordings where it is left out.
        format: coco and yolo = 2D boxes; the others hold 3D boxes.
        pictures: coco, yolo: folder of pseudo-view pictures that the boxes were drawn on (`annotator views` writes
            such); without it the boxes are on the camera images, whose names must be those of the project's frames,
            and on those pseudo-views that a `views.json` beside them names.
        kind: coco, yolo: silhouette = around what is seen; box = the projection of a 3D box.
        recording: which recording the boxes belong to, where several have frames of the same name.
        as_2d: 3D boxes as 2D boxes alone, the frames stay without 3D labels.
        fraction: as-2d: share of the labelled frames to take, above 0 and at most 1.
        seed: as-2d: of the choice of these frames.
        root: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
    """
    if pictures is not None and recording is not None:
        raise ConfigError("--recording says where camera images belong; the boxes on --pictures belong to pseudo-views")
    if pictures is not None and format not in FLAT:
        raise ConfigError(f"--pictures is for 2D boxes ({', '.join(FLAT)}); {format} holds 3D boxes")
    if not as_2d and (fraction, seed) != (1.0, 0):
        raise ConfigError("--fraction and --seed choose among the frames of --as-2d")
    if as_2d and pictures is not None:
        raise ConfigError("--as-2d makes its pictures from 3D boxes; leave --pictures away")
    with open_named(project, root) as opened:
        if as_2d:
            labels = import_as_2d(opened, path, format, recording, fraction, seed)
            _renamed(labels.renamed)
            _left_out({}, labels.unmatched, "frames")
            print_line(f"next: annotator train {project}")
        elif path is None:
            raise ConfigError(
                f"which labels? annotator import {project} PATH; or --as-2d for those beside the recordings"
            )
        elif format in FLAT:
            _flat(opened, path, FlatFormat(format), pictures, kind, recording)
        else:
            _boxes(opened, path, BoxFormat(format), recording)


def _flat(
    project: Project, path: Path, format: FlatFormat, pictures: Path | None, kind: BoxKind, recording: str | None
) -> None:
    if pictures is None:
        done = import_image_boxes(project, path, kind, recording, format)
    else:
        done = import_view_boxes(project, path, pictures, kind, format)
    found = {"camera images": done.pictures - done.views, "pseudo-views": done.views}
    where = " and ".join(f"{number} {what}" for what, number in found.items() if number) or "no picture"
    print_line(f"{done.boxes} boxes on {where}")
    if done.replaced:
        print_line(f"replaced: the boxes that somebody had drawn on {done.replaced} camera images")
    if done.finalised:
        print_line(f"left alone: {done.finalised} pictures of finalised frames")
    for line in done.unreadable:
        print_line(f"unreadable: {line}")
    _renamed(done.renamed)
    _left_out(done.other_classes, done.unmatched, "images")


def _boxes(project: Project, path: Path, format: BoxFormat, recording: str | None) -> None:
    found = read_labels(format, path)
    with counted(f"import {format}") as progress:
        done = import_labels(project, found, recording, progress)
    classes = ", ".join(f"{number} {name}" for name, number in sorted(done.labels.items())) or "no box"
    print_line(f"{done.frames} frames: {classes}")
    if done.already:
        print_line(f"left alone: {done.already} frames that have labels already or are finalised")
    if done.not_reviewed:
        print_line(f"left behind: {done.not_reviewed} boxes that nobody has accepted")
    if done.scores:
        print_line(f"left behind: {done.scores} scores, which are no confidences in 0..1")
    for line in done.unreadable:
        print_line(f"unreadable: {line}")
    _renamed(done.renamed)
    _left_out(done.other_classes, done.unmatched, "frames")


def _renamed(renamed: Renamed | None) -> None:
    if renamed is not None:
        print_line(f"taken for {', '.join(renamed.taken_for)}: the recording that the labels call {renamed.named}")


def _left_out(other_classes: Counter[str] | dict[str, int], unmatched: Sequence[str], what: str) -> None:
    for label, number in other_classes.items():
        print_line(f"left out: {number} boxes of class {label}, which the project does not have")
    if unmatched:
        names = ", ".join(unmatched[:5]) + (" ..." if len(unmatched) > 5 else "")
        print_line(f"left out: {len(unmatched)} {what} that are no frames of the project: {names}")
