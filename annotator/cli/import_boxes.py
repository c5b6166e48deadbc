"""`annotator import`"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from annotator.cli.import_as_2d import import_as_2d
from annotator.cli.options import BoxKindOption, ProjectName, Projects, Seed
from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.cli.projects import open_named
from annotator.formats.units import AngleUnit
from annotator.project import Project
from annotator.types import BoxKind
from annotator.types.errors import ConfigError
from annotator.types.messages import amount, nearest
from annotator.workflows.importing import (
    BoxFormat,
    FlatFormat,
    LabelSet,
    Renamed,
    class_names,
    format_of,
    import_image_boxes,
    import_labels,
    import_proposals,
    import_view_boxes,
    new_attributes,
    read_labels,
    without_effect,
)
from annotator.workflows.importing.label_set import ProposalSet, classes_of
from annotator.workflows.importing.new_attributes import FoundValues, values_of_labels, values_of_pictures
from annotator.workflows.importing.picture_labels import read_pictures

FLAT = tuple(FlatFormat)
ADVICE = (
    "`annotator classes attribute` gives a project attributes; `annotator import PROJECT PATH --add-attributes` gives "
    "it those of a file, and its labels their values"
)
OUTSIDE = "skipped: {} outside the images of these frames"
REPEATED_TRACKS = "dropped: {} that an earlier box of the same frame has"
# One enumeration of all formats, so that tyro lists them in the help.
Format = StrEnum("Format", {name.upper(): name for name in (*FLAT, *BoxFormat)})  # type: ignore[misc]


class As(StrEnum):
    """What 3D boxes become."""

    LABELS = "labels"
    PROPOSALS = "proposals"
    FLAT = "2d"


As_ = Annotated[
    As,
    arg(
        name="as",
        help="what 3D boxes become: labels, on frames without labels and proposals; proposals, to be reviewed, on all "
        "frames; or 2d: 2D training boxes on the camera image and on the pseudo-views of the first two steps, without "
        "3D labels.",
    ),
]


def run(
    project: ProjectName,
    path: Path | None = None,
    /,
    *,
    as_: As_ = As.LABELS,
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
    projects: Projects = None,
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
    if as_ is not As.FLAT and (fraction, seed) != (1.0, 0):
        raise ConfigError("--fraction and --seed need --as 2d")
    if as_ is not As.PROPOSALS and (source, min_score) != (None, None):
        raise ConfigError("--source and --min-score need --as proposals")
    if as_ is As.FLAT and pictures is not None:
        raise ConfigError("--as 2d renders its pictures from 3D boxes; leave out --pictures")
    if as_ is As.FLAT and add_attributes:
        raise ConfigError("--add-attributes is for labels and proposals; 2D boxes of the project have no attributes")
    if angles is not None and path is None:
        raise ConfigError("--angles is for a file or folder of 3D boxes; give its path")
    with open_named(project, projects) as opened:
        names = {} if classes is None else class_names(classes, opened)
        if path is None:
            if as_ is not As.FLAT:
                raise ConfigError(
                    f"no labels given; write annotator import {project} PATH, or --as 2d for the recordings' own labels"
                )
            found = None
        else:
            found = FlatFormat(format) if format in FLAT else format_of(path) if format is None else BoxFormat(format)
        if isinstance(found, FlatFormat) and as_ is not As.LABELS:
            raise ConfigError(f"{path} is {found}, which contains no 3D boxes; leave out --as")
        if angles is not None and isinstance(found, FlatFormat):
            raise ConfigError(f"--angles is for 3D boxes; {path} is {found}, which contains none")
        if pictures is not None and not isinstance(found, FlatFormat):
            raise ConfigError(f"--pictures is for 2D boxes ({', '.join(FLAT)}); {found} contains 3D boxes")
        if as_ is As.FLAT:
            assert not isinstance(found, FlatFormat)
            if names and path is not None and found is not None:
                _check_names(names, classes_of(opened, read_labels(found, path, angles)))
            labels = import_as_2d(opened, path, found, recording, names, fraction, seed, angles)
            print_renamed(labels.renamed)
            print_left_out({}, labels.unmatched, "frame")
            print_line(f"next: annotator train {project}")
        elif isinstance(found, FlatFormat):
            assert path is not None
            if names:
                _check_names(names, {label for each in read_pictures(found, path).pictures for label in each.labels})
            if add_attributes:
                _add(opened, values_of_pictures(found, path))
            _flat(opened, path, found, pictures, box_kind, recording, names)
        else:
            assert path is not None and found is not None
            dataset = read_labels(found, path, angles)
            if names:
                _check_names(names, classes_of(opened, dataset))
            if add_attributes:
                _add(opened, values_of_labels(dataset))
            if as_ is As.PROPOSALS:
                _proposals(opened, dataset, found, source, recording, min_score, names)
            else:
                _boxes(opened, dataset, found, recording, names, add_attributes)


def _check_names(names: Mapping[str, str], present: Collection[str]) -> None:
    for line in without_effect(names, present):
        print_line(line)


def _add(project: Project, found: FoundValues) -> None:
    for each in new_attributes.add_attributes(project, found):
        print_line(f"added: attribute {each.name} of a {each.of}: {each.values_text()}")


def _flat(
    project: Project,
    path: Path,
    format: FlatFormat,
    pictures: Path | None,
    kind: BoxKind | None,
    recording: str | None,
    names: Mapping[str, str],
) -> None:
    if pictures is None:
        done = import_image_boxes(project, path, kind, recording, format, names)
    else:
        done = import_view_boxes(project, path, pictures, kind, format, names)
    counts = {"camera image": done.pictures - done.views, "pseudo-view": done.views}
    where = " and ".join(amount(number, what) for what, number in counts.items() if number) or "no image"
    print_line(f"{amount(done.boxes, 'box')} on {where}")
    if done.around:
        print_line(f"turned or polygons: {amount(done.around, 'box')}; the rectangles around them were imported")
    if done.replaced:
        print_line(f"replaced: the boxes on {amount(done.replaced, 'camera image')}")
    if done.finalised:
        print_line(f"unchanged: {amount(done.finalised, 'image')} of finalised frames")
    if done.values.set:
        print_line(
            f"attributes: {amount(done.values.set, 'value')} for the 3D labels and frames that these images show"
        )
    if done.values.kept:
        kept = amount(done.values.kept, "value")
        print_line(f"unchanged: {kept} of labels and frames in conflict with the file")
    for line in done.unreadable:
        print_line(f"unreadable: {line}")
    print_renamed(done.renamed)
    for line in left_out_values(done.values.left_out):
        print_line(line)
    print_left_out(done.other_classes, done.unmatched, "image", project.config.classes)


def _proposals(
    project: Project,
    labels: ProposalSet,
    format: BoxFormat,
    source: str | None,
    recording: str | None,
    min_score: float | None,
    names: Mapping[str, str],
) -> None:
    with counted(f"import {format}") as progress:
        done = import_proposals(
            project, labels, source, recording=recording, min_score=min_score, names=names, progress=progress
        )
    print_line(f"{done.source}: {_by_class(done.proposals)} proposed on {amount(done.frames, 'frame')}")
    for number, what in (
        (done.merged, "merged: {} with proposals of other sources"),
        (done.covered, "skipped: {} of reviewed objects"),
        (done.unsure, "skipped: {} with a lower score"),
        (done.rejected, "skipped: {} rejected before"),
        (done.unseen, OUTSIDE),
    ):
        if number:
            print_line(what.format(amount(number, "box")))
    if done.flat:
        print_line(flat_rows(done.flat))
    if done.doubt is not None:
        print_line(f"doubtful: {done.doubt}")
    if done.conflicts:
        print_line(
            f"in conflict with other sources: {amount(done.conflicts, 'value')}; those of the surer boxes are shown"
        )
    if done.finalised:
        print_line(f"unchanged: {amount(done.finalised, 'finalised frame')}")
    if min_score is not None and done.proposals and not done.scored:
        print_line("the boxes have no scores, so --min-score has no effect")
    if done.scaled is not None:
        print_line(f"scaled: scores from {done.scaled.low:g} to {done.scaled.high:g} are now 0 to 1")
    if done.tracks:
        print_line(REPEATED_TRACKS.format(amount(done.tracks, "track id")))
    for line in done.unreadable:
        print_line(f"unreadable: {line}")
    print_renamed(done.renamed)
    for line in left_out_values(done.values):
        print_line(line)
    print_left_out(done.other_classes, done.unmatched, "frame", project.config.classes)
    if done.proposals:
        print_line(f"next: annotator serve, to review {project.config.name}")


def _by_class(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{number} {name}" for name, number in sorted(counts.items())) or "no box"


def _boxes(
    project: Project, labels: LabelSet, format: BoxFormat, recording: str | None, names: Mapping[str, str], fill: bool
) -> None:
    with counted(f"import {format}") as progress:
        done = import_labels(project, labels, recording, progress, names, fill=fill)
    print_line(f"{amount(done.frames, 'frame')}: {_by_class(done.labels)}")
    if done.already:
        already = f"{amount(done.already, 'frame')} with labels or proposals already, or finalised"
        print_line(f"unchanged: {already}; --as proposals adds boxes beside labels")
    if done.filled:
        print_line(f"attributes: {amount(done.filled, 'value')} for labels and frames that had none")
    if done.not_reviewed:
        print_line(f"skipped: {amount(done.not_reviewed, 'box')} not accepted")
    if done.unseen:
        print_line(OUTSIDE.format(amount(done.unseen, "box")))
    if done.flat:
        print_line(flat_rows(done.flat))
    if done.doubt is not None:
        print_line(f"doubtful: {done.doubt}")
    if done.scores:
        print_line(f"dropped: {amount(done.scores, 'score')} outside 0..1")
    if done.tracks:
        print_line(REPEATED_TRACKS.format(amount(done.tracks, "track id")))
    for line in done.unreadable:
        print_line(f"unreadable: {line}")
    print_renamed(done.renamed)
    for line in left_out_values(done.values):
        print_line(line)
    print_left_out(done.other_classes, done.unmatched, "frame", project.config.classes)


def flat_rows(number: int) -> str:
    """The line that says how many rows of 2D boxes were left out."""
    return f"skipped: {amount(number, 'row')} with a 2D box and no 3D box (its height, width and length are -1)"


def left_out_values(values: Mapping[str, int]) -> list[str]:
    """Lines that say which values of attributes were left out."""
    lines = [f"skipped: {amount(number, 'value')} of attribute {what}" for what, number in sorted(values.items())]
    return [*lines, ADVICE] if lines else []


def print_renamed(renamed: Renamed | None) -> None:
    if renamed is not None:
        print_line(f"recording {renamed.named} of the labels was assigned to {', '.join(renamed.taken_for)}")


def print_left_out(
    other_classes: Mapping[str, int], unmatched: Sequence[str], what: str, known: Sequence[str] = ()
) -> None:
    """Prints what an import left out.

    Args:
        other_classes: numbers of boxes of classes that the project does not have.
        unmatched: names of frames or images that the project does not have.
        what: what these are the names of: frame, or image.
        known: the project's classes.
    """
    for label, number in other_classes.items():
        near = nearest(label, known)
        meant = "" if near is None else f"; did you mean {near!r}?"
        print_line(f"skipped: {amount(number, 'box')} of class {label}, which is not in the project{meant}")
    if unmatched:
        names = ", ".join(unmatched[:5]) + (" ..." if len(unmatched) > 5 else "")
        print_line(f"skipped: {amount(len(unmatched), what)} without a match in the project: {names}")
