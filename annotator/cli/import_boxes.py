"""`annotator import`"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path

from annotator.cli.import_as_2d import import_as_2d
from annotator.cli.options import BoxKindOption, ProjectName, Projects, Seed
from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.cli.projects import open_named
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
# One enumeration of all formats, so that tyro lists them in the help.
Format = StrEnum("Format", {name.upper(): name for name in (*FLAT, *BoxFormat)})  # type: ignore[misc]


def run(
    project: ProjectName,
    path: Path | None = None,
    /,
    *,
    format: Format = Format.COCO,  # type: ignore[attr-defined]
    pictures: Path | None = None,
    box_kind: BoxKindOption = BoxKind.SILHOUETTE,
    recording: str | None = None,
    as_2d: bool = False,
    fraction: float = 1.0,
    seed: Seed = 0,
    projects: Projects = None,
) -> None:
    """Import boxes from files: 3D boxes, or 2D boxes on camera images or pseudo-views.

    Frames that have no label yet get the 3D boxes as accepted labels. With --as-2d, 3D boxes only become 2D training
    boxes, on the camera image and on the pseudo-views of the first two steps.

    Args:
        path: file or folder of the labels; default with --as-2d: the labels that come with the recordings.
        format: coco and yolo contain 2D boxes, the other formats 3D boxes.
        pictures: with coco and yolo: folder of the labelled pseudo-views, written by `annotator views`. Without this
            option, the boxes are on camera images named like the project's frames, and on the pseudo-views listed in a
            `views.json` in the folder of those images.
        recording: name of the recording that the boxes belong to, if several have frames of the same name.
        as_2d: import 3D boxes as 2D boxes only; the frames get no 3D labels.
        fraction: with --as-2d: share of the labelled frames to import, above 0 and at most 1.
    """
    if pictures is not None and recording is not None:
        raise ConfigError("--recording is for boxes on camera images; the boxes on --pictures are on pseudo-views")
    if pictures is not None and format not in FLAT:
        raise ConfigError(f"--pictures is for 2D boxes ({', '.join(FLAT)}); {format} contains 3D boxes")
    if not as_2d and (fraction, seed) != (1.0, 0):
        raise ConfigError("--fraction and --seed need --as-2d")
    if as_2d and pictures is not None:
        raise ConfigError("--as-2d renders its pictures from 3D boxes; leave out --pictures")
    with open_named(project, projects) as opened:
        if as_2d:
            labels = import_as_2d(opened, path, format, recording, fraction, seed)
            print_renamed(labels.renamed)
            print_left_out({}, labels.unmatched, "frames")
            print_line(f"next: annotator train {project}")
        elif path is None:
            raise ConfigError(
                f"no labels given; write annotator import {project} PATH, or --as-2d for the recordings' own labels"
            )
        elif format in FLAT:
            _flat(opened, path, FlatFormat(format), pictures, box_kind, recording)
        else:
            _boxes(opened, path, BoxFormat(format), recording)


def _flat(
    project: Project, path: Path, format: FlatFormat, pictures: Path | None, kind: BoxKind, recording: str | None
) -> None:
    if pictures is None:
        done = import_image_boxes(project, path, kind, recording, format)
    else:
        done = import_view_boxes(project, path, pictures, kind, format)
    counts = {"camera images": done.pictures - done.views, "pseudo-views": done.views}
    where = " and ".join(f"{number} {what}" for what, number in counts.items() if number) or "no image"
    print_line(f"{done.boxes} boxes on {where}")
    if done.replaced:
        print_line(f"replaced: the boxes on {done.replaced} camera images")
    if done.finalised:
        print_line(f"unchanged: {done.finalised} images of finalised frames")
    for line in done.unreadable:
        print_line(f"unreadable: {line}")
    print_renamed(done.renamed)
    print_left_out(done.other_classes, done.unmatched, "images")


def _boxes(project: Project, path: Path, format: BoxFormat, recording: str | None) -> None:
    labels = read_labels(format, path)
    with counted(f"import {format}") as progress:
        done = import_labels(project, labels, recording, progress)
    classes = ", ".join(f"{number} {name}" for name, number in sorted(done.labels.items())) or "no box"
    print_line(f"{done.frames} frames: {classes}")
    if done.already:
        print_line(f"unchanged: {done.already} frames that already have labels or are finalised")
    if done.not_reviewed:
        print_line(f"skipped: {done.not_reviewed} boxes that are not accepted")
    if done.scores:
        print_line(f"dropped: {done.scores} scores outside 0..1")
    for line in done.unreadable:
        print_line(f"unreadable: {line}")
    print_renamed(done.renamed)
    print_left_out(done.other_classes, done.unmatched, "frames")


def print_renamed(renamed: Renamed | None) -> None:
    if renamed is not None:
        print_line(f"recording {renamed.named} of the labels was assigned to {', '.join(renamed.taken_for)}")


def print_left_out(other_classes: Mapping[str, int], unmatched: Sequence[str], what: str) -> None:
    for label, number in other_classes.items():
        print_line(f"skipped: {number} boxes of class {label}, which is not in the project")
    if unmatched:
        names = ", ".join(unmatched[:5]) + (" ..." if len(unmatched) > 5 else "")
        print_line(f"skipped: {len(unmatched)} {what} that match no frame of the project: {names}")
