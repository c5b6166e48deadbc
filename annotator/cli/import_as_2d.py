"""`annotator import --as-2d`: what it does and says."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.project import Project
from annotator.types.errors import ConfigError
from annotator.workflows.boxes_from_3d import BoxesFrom3d, boxes_from_3d
from annotator.workflows.importing import BoxFormat, read_labels
from annotator.workflows.known_labels import KnownLabels, labels_beside, labels_from


def import_as_2d(
    project: Project, path: Path | None, format: str, recording: str | None, fraction: float, seed: int
) -> KnownLabels:
    """Keeps the 2D boxes of known 3D boxes, and tells of them.

    Args:
        path: of the labels; None = those beside the recordings, whatever their format.

    Returns:
        The labels that there were.

    Raises:
        ConfigError: a format without 3D boxes, no labels, or none of the project's classes.
        FormatError: labels that cannot be read, or that fit no frame.
    """
    labels = _labels(project, path, format, recording)
    with counted("2D boxes") as progress:
        done = boxes_from_3d(project, labels, fraction=fraction, seed=seed, progress=progress)
    for line in _told(done, len(labels.frames)):
        print_line(line)
    return labels


def _labels(project: Project, path: Path | None, format: str, recording: str | None) -> KnownLabels:
    if path is None:
        return labels_beside(project, None if recording is None else [project.recordings.find(recording).id])
    if format not in tuple(BoxFormat):
        raise ConfigError(f"{format} holds no 3D boxes; say which format {path} has: --format {'|'.join(BoxFormat)}")
    return labels_from(project, read_labels(BoxFormat(format), path), recording)


def _told(done: BoxesFrom3d, labelled: int) -> list[str]:
    lines = [
        f"{done.frames} of {labelled} labelled frames: {_by_class(done.image_boxes)} on camera images; "
        f"{_by_class(done.objects)} on {done.views} pseudo-views, which show {done.view_boxes} boxes"
    ]
    for counter, why in (
        (done.without_views, "on the image alone, with too few points for pseudo-views"),
        (done.outside, "out of the picture"),
        (done.hidden, "behind something else, without a point of their own"),
        (done.other_classes, "left out, of classes that the project does not have"),
    ):
        if counter:
            lines.append(f"  {why}: {_by_class(counter)}")
    if done.not_reviewed:
        lines.append(f"  left behind: {done.not_reviewed} boxes that nobody has accepted")
    if done.drawn:
        lines.append(f"  left alone: {done.drawn} frames that somebody has drawn on or finalised")
    if done.others_views:
        lines.append(f"  left alone: {done.others_views} pseudo-views with boxes that somebody else has set")
    lines += [f"  unreadable: {line}" for line in done.unreadable]
    return [*lines, f"in all, {done.in_all} frames carry 2D boxes made of 3D boxes"]


def _by_class(counter: Counter[str]) -> str:
    return ", ".join(f"{number} {label}" for label, number in sorted(counter.items())) or "nothing"
