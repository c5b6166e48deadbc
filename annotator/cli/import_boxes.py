"""`annotator import`"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from annotator.cli.options import BoxKindOption, Seed, ids_of
from annotator.cli.output import counted, print_line, print_lines
from annotator.formats.reading import AngleUnit
from annotator.formats.table import named_format
from annotator.project import Project
from annotator.types import BoxKind
from annotator.types.errors import ConfigError
from annotator.workflows import importing
from annotator.workflows.importing.pictures import read_pictures
from annotator.workflows.importing.placing import class_names
from annotator.workflows.importing.values import FoundValues, add_attributes, values_of_labels, values_of_pictures
from annotator.workflows.recorded.boxes_from_3d import boxes_from_3d
from annotator.workflows.recorded.own_labels import RecordedLabels

FLAT = tuple(importing.FlatFormat)
ADVICE = (
    "`annotator classes attribute` gives a project attributes; `annotator import PROJECT PATH --add-attributes` gives "
    "it those of a file, and its labels their values"
)
# One enumeration of all formats, so that tyro lists them in the help.
Format = StrEnum("Format", {name.upper(): name for name in (*FLAT, *importing.BoxFormat)})  # type: ignore[misc]
As_ = Annotated[
    importing.Become,
    arg(
        name="as",
        help="what 3D boxes become: labels, on frames without labels and proposals; proposals, to be reviewed, on all "
        "frames; or 2d: 2D training boxes on the camera image and on the pseudo-views of the first two steps, without "
        "3D labels.",
    ),
]


def run(
    project: Project,
    path: Path | None = None,
    /,
    *,
    as_: As_ = importing.Become.LABELS,
    format: Format | None = None,
    source: str | None = None,
    min_score: float | None = None,
    classes: str | None = None,
    add_attributes: bool = False,
    angles: AngleUnit | None = None,
    pictures: Path | None = None,
    box_kind: BoxKindOption[BoxKind | None] = None,
    recording: str | None = None,
    fraction: float = 1.0,
    seed: Seed = 0,
) -> None:
    """Import boxes from files: 3D boxes, or 2D boxes on camera images or pseudo-views.

    3D boxes become accepted labels, proposals or 2D boxes (--as). Proposals of several sources stay side by side: one
    object is one proposal, with the surest box. A second import of the same source replaces the first.

    Args:
        path: file or folder of the labels; default with --as 2d: the labels that come with the recordings.
        format: format of the labels; default: recognised from the files.
        source: with --as proposals: name under which the boxes are known, such as that of their detector; default: the
            name of the file or folder.
        min_score: with --as proposals: leave out boxes with a lower score; scores as in the file.
        classes: the project's classes of the file's classes, such as Car=car,Van=car; others keep their names.
        add_attributes: give the project the attributes of the file that it lacks, with the kind that their values have,
            and labels that it has already the values that they lack.
        angles: unit of the angles of 3D boxes, if the format or the file says another one, or if it is not clear.
        pictures: with coco and yolo: folder of the labelled pseudo-views, written by `annotator views`. Without this
            option, the boxes are on camera images named like the project's frames, and on the pseudo-views listed in a
            `views.json` in the folder of those images.
        recording: name of the recording that the boxes belong to, if several have frames of the same name.
        fraction: with --as 2d: share of the labelled frames to import, above 0 and at most 1.
    """
    if pictures is not None and recording is not None:
        raise ConfigError("--recording is for boxes on camera images; the boxes on --pictures are on pseudo-views")
    if as_ is not importing.Become.FLAT and (fraction, seed) != (1.0, 0):
        raise ConfigError("--fraction and --seed need --as 2d")
    if as_ is not importing.Become.PROPOSALS and (source, min_score) != (None, None):
        raise ConfigError("--source and --min-score need --as proposals")
    if as_ is importing.Become.FLAT and pictures is not None:
        raise ConfigError("--as 2d renders its pictures from 3D boxes; leave out --pictures")
    if as_ is importing.Become.FLAT and add_attributes:
        raise ConfigError("--add-attributes is for labels and proposals; 2D boxes of the project have no attributes")
    if angles is not None and path is None:
        raise ConfigError("--angles is for a file or folder of 3D boxes; give its path")
    if path is None and as_ is not importing.Become.FLAT:
        raise ConfigError(
            f"no labels given; write annotator import {project.path.name} PATH, or --as 2d for the labels of recordings"
        )
    names = {} if classes is None else class_names(classes, project)
    found = None if path is None else importing.format_of(path) if format is None else named_format(format)
    if isinstance(found, importing.FlatFormat):
        assert path is not None
        if as_ is not importing.Become.LABELS:
            raise ConfigError(f"{path} is {found}, which contains no 3D boxes; leave out --as")
        if angles is not None:
            raise ConfigError(f"--angles is for 3D boxes; {path} is {found}, which contains none")
        if names:
            present = {label for each in read_pictures(found, path).pictures for label in each.labels}
            print_lines(importing.without_effect(names, present))
        if add_attributes:
            _add(project, values_of_pictures(found, path))
        if pictures is None:
            report = importing.import_image_boxes(project, path, box_kind, recording, found, names)
        else:
            report = importing.import_view_boxes(project, path, pictures, box_kind, found, names)
        print_report(report)
        return
    if pictures is not None:
        raise ConfigError(f"--pictures is for 2D boxes ({', '.join(FLAT)}); {found} contains 3D boxes")
    labels: importing.LabelSet
    if path is None or found is None:
        chosen = ids_of(project, () if recording is None else (recording,))
        labels = RecordedLabels(project, chosen, with_files=True)
    else:
        labels = importing.read_labels(found, path, angles).in_project(project)
        present = {label for name in labels.frames for label in labels.classes(name)}
        print_lines(importing.without_effect(names, present))
    if add_attributes:
        _add(project, values_of_labels(labels))
    with counted("2D boxes" if as_ is importing.Become.FLAT else f"import {found}") as progress:
        if as_ is importing.Become.FLAT:
            report = boxes_from_3d(
                project, labels, recording=recording, names=names, fraction=fraction, seed=seed, progress=progress
            )
        elif as_ is importing.Become.PROPOSALS:
            report = importing.import_proposals(
                project, labels, source, recording=recording, min_score=min_score, names=names, progress=progress
            )
        else:
            report = importing.import_labels(project, labels, recording, progress, names, fill=add_attributes)
    print_report(report)
    if as_ is importing.Become.FLAT:
        print_line(f"next: annotator train {project.path.name}")
    elif as_ is importing.Become.PROPOSALS and report.boxes:
        print_line(f"next: annotator serve, to review {project.config.name}")


def _add(project: Project, found: FoundValues) -> None:
    added = add_attributes(project, found)
    print_lines(f"added: attribute {each.name} of a {each.of}: {each.values_text()}" for each in added)


def print_report(report: importing.ImportReport, indent: str = "") -> None:
    """Prints what an import tells."""
    lines = (report.headline(), *report.sentences(), *([ADVICE] if report[importing.Note.VALUE] else []))
    print_lines(indent + line for line in lines)
