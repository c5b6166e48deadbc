"""`annotator import --as 2d`"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.formats.units import AngleUnit
from annotator.project import Project
from annotator.types.messages import amount
from annotator.workflows.importing import BoxFormat, read_labels
from annotator.workflows.recorded.boxes_from_3d import BoxesFrom3d, boxes_from_3d
from annotator.workflows.recorded.labelled_frames import KnownLabels, labels_beside, labels_from


def import_as_2d(
    project: Project,
    path: Path | None,
    format: BoxFormat | None,
    recording: str | None,
    names: Mapping[str, str],
    fraction: float,
    seed: int,
    angles: AngleUnit | None,
) -> KnownLabels:
    """Imports the 2D boxes of known 3D boxes, and prints a summary.

    Args:
        project: the project to import into.
        path: file or folder of the labels; None = those that come with the recordings, in any format.
        format: format of the labels at `path`.
        recording: name of the recording that the labels belong to; None = all.
        names: the project's class of each class of the labels that has another name.
        fraction: share of the labelled frames to import.
        seed: seed of the choice of frames.
        angles: unit of the angles of the labels at `path`; None: as their format says.

    Returns:
        The 3D labels.

    Raises:
        ConfigError: there are no labels, or none of the project's classes.
        FormatError: the labels cannot be read, or match no frame.
    """
    if path is None or format is None:
        labels = labels_beside(project, None if recording is None else [project.recordings.find(recording).id])
    else:
        labels = labels_from(project, read_labels(format, path, angles), recording)
    labels = labels.renamed_to(names)
    with counted("2D boxes") as progress:
        done = boxes_from_3d(project, labels, fraction=fraction, seed=seed, progress=progress)
    for line in _summary(done, len(labels.frames)):
        print_line(line)
    if labels.flat:
        print_line(f"  skipped: {amount(labels.flat, 'row')} with a 2D box and no 3D box")
    return labels


def _summary(done: BoxesFrom3d, labelled: int) -> list[str]:
    lines = [
        f"{done.frames} of {amount(labelled, 'labelled frame')}: {_by_class(done.image_boxes)} on camera images; "
        f"{_by_class(done.objects)} on {amount(done.views, 'pseudo-view')} with {amount(done.view_boxes, 'box')}"
    ]
    for counter, why in (
        (done.without_views, "on the image only, too few points for pseudo-views"),
        (done.outside, "outside the image"),
        (done.hidden, "hidden, without points of their own"),
        (done.other_classes, "skipped, of classes that are not in the project"),
    ):
        if counter:
            lines.append(f"  {why}: {_by_class(counter)}")
    if done.not_reviewed:
        lines.append(f"  skipped: {amount(done.not_reviewed, 'box')} not accepted")
    if done.drawn:
        lines.append(f"  unchanged: {amount(done.drawn, 'frame')} with drawn boxes, or finalised")
    if done.others_views:
        lines.append(f"  unchanged: {amount(done.others_views, 'pseudo-view')} with boxes from elsewhere")
    lines += [f"  unreadable: {line}" for line in done.unreadable]
    return [*lines, f"{amount(done.in_all, 'frame')} in total with 2D boxes made from 3D boxes"]


def _by_class(counter: Counter[str]) -> str:
    return ", ".join(f"{number} {label}" for label, number in sorted(counter.items())) or "nothing"
