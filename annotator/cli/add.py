"""`annotator add`"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from annotator.cli.output import print_line
from annotator.cli.projects import Root, open_named
from annotator.types.errors import ConfigError
from annotator.workflows.recordings import Added, add_recordings


def run(
    project: str,
    paths: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="PATH ...", help_behavior_hint="(required)")],
    /,
    *,
    name: str | None = None,
    up: tuple[float, float, float] | None = None,
    root: Root = None,
) -> None:
    """Put recordings into a project. Their files stay where they are.

    A recording that the project has already is looked at again for new frames.

    Args:
        project: the project's name.
        paths: of the recordings.
        name: what to call the recording; default: its folder's name.
        up: direction against gravity in the camera frame (x right, y down, z forward), for a recording that does not
            know it; a level camera has 0 -1 0.
        root: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
    """
    if not paths:
        raise ConfigError(f"which recordings? annotator add {project} PATH ...")
    with open_named(project, root) as opened:
        for added in add_recordings(opened, paths, name=name, up=up):
            print_line(_told(added))


def _told(added: Added) -> str:
    recording = added.recording
    if added.is_new:
        return f"added {recording.name}: {recording.frames} frames ({recording.format})"
    gone = f", {added.missing_frames} are gone (their labels stay)" if added.missing_frames else ""
    return f"{recording.name} was there already: {added.new_frames} new frames{gone}"
