"""`annotator move`"""

from __future__ import annotations

from pathlib import Path

from annotator.cli.output import print_line
from annotator.cli.projects import Root, open_named
from annotator.workflows.recordings import move_recording

AUTHOR = "annotator move"


def run(project: str, recording: str, path: Path, /, *, root: Root = None) -> None:
    """Say where a recording is now whose folder was moved. All its frames must be there; labels and boxes stay.

    Args:
        project: the project's name.
        recording: its name in the project; a wrong one lists those there are.
        path: where it is now.
        root: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
    """
    with open_named(project, root) as opened:
        before = opened.recordings.find(recording)
        now = move_recording(opened, before.id, path, AUTHOR)
    new = now.frames - before.frames
    grown = f" ({new} new)" if new > 0 else ""
    print_line(f"{now.name}: {now.frames} frames{grown}, now at {now.path}")
