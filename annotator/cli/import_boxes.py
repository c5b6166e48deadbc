"""`annotator import`"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path

from annotator.cli.output import print_line
from annotator.cli.projects import Root, open_named
from annotator.types import BoxKind
from annotator.types.errors import ConfigError
from annotator.workflows.import_coco import import_image_boxes, import_view_boxes


class Format(StrEnum):
    """Formats that labels can come in."""

    COCO = "coco"


def run(
    project: str,
    file: Path,
    /,
    *,
    format: Format = Format.COCO,
    pictures: Path | None = None,
    kind: BoxKind = BoxKind.SILHOUETTE,
    recording: str | None = None,
    root: Root = None,
) -> None:
    """Take over 2D boxes that were drawn elsewhere, on camera images or on pseudo-views.

    Args:
        project: the project's name.
        file: COCO JSON.
        format: of the file.
        pictures: folder of pseudo-view pictures that the boxes were drawn on (`annotator views` writes such); without
            it the boxes are on the camera images, whose names must be those of the project's frames.
        kind: silhouette = around what is seen; box = the projection of a 3D box.
        recording: which recording the camera images belong to, where several have frames of the same name.
        root: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
    """
    if pictures is not None and recording is not None:
        raise ConfigError("--recording says where camera images belong; the boxes on --pictures belong to pseudo-views")
    with open_named(project, root) as opened:
        if pictures is None:
            done = import_image_boxes(opened, file, kind, recording)
        else:
            done = import_view_boxes(opened, file, pictures, kind)
    what = "camera images" if pictures is None else "pseudo-views"
    print_line(f"{done.boxes} boxes on {done.pictures} {what}")
    for label, number in done.other_classes.items():
        print_line(f"left out: {number} boxes of class {label}, which the project does not have")
    if done.unmatched:
        names = ", ".join(done.unmatched[:5]) + (" ..." if len(done.unmatched) > 5 else "")
        print_line(f"left out: {len(done.unmatched)} images that are no frames of the project: {names}")
