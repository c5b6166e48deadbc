"""`annotator add`"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.cli.projects import Root, open_named
from annotator.project import REVIEWED
from annotator.types.errors import ConfigError
from annotator.workflows.own_labels import OwnLabels, import_own_labels
from annotator.workflows.recordings import Added, add_recordings


def run(
    project: str,
    paths: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="PATH ...", help_behavior_hint="(required)")],
    /,
    *,
    name: str | None = None,
    up: tuple[float, float, float] | None = None,
    no_labels: bool = False,
    root: Root = None,
) -> None:
    """Put recordings into a project. Their files stay where they are.

    3D boxes that a recording brings (label_2, label_02.txt, boxes.json) become imported labels, which the detectors
    learn from. A recording that the project has already is looked at again for new frames.

    Args:
        project: the project's name.
        paths: of the recordings.
        name: what to call the recording; default: its folder's name.
        up: direction against gravity in the camera frame (x right, y down, z forward), for a recording that does not
            know it; a level camera has 0 -1 0.
        no_labels: leave the recordings' own 3D boxes alone.
        root: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
    """
    if not paths:
        raise ConfigError(f"which recordings? annotator add {project} PATH ...")
    with open_named(project, root) as opened:
        for added in add_recordings(opened, paths, name=name, up=up):
            print_line(_told(added))
            if not no_labels:
                with counted("reading labels") as progress:
                    own = import_own_labels(opened, added.recording.id, progress)
                for line in _told_labels(own):
                    print_line(line)
        if not opened.labels.select(states=REVIEWED):
            print_line(f"next: draw boxes (annotator simulate, annotator import), then annotator train {project}")
        else:
            print_line(f"next: annotator train {project}")


def _told_labels(own: OwnLabels) -> list[str]:
    lines = [f"  {number} boxes of class {label} imported as labels" for label, number in sorted(own.labels.items())]
    lines += [
        f"  left out: {number} boxes of class {label}, which the project does not have"
        for label, number in sorted(own.other_classes.items())
    ]
    return lines + [f"  unreadable: {line}" for line in own.unreadable]


def _told(added: Added) -> str:
    recording = added.recording
    if added.is_new:
        return f"added {recording.name}: {recording.frames} frames ({recording.format})"
    gone = f", {added.missing_frames} are gone (their labels stay)" if added.missing_frames else ""
    return f"{recording.name} was there already: {added.new_frames} new frames{gone}"
