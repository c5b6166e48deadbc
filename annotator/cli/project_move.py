"""`annotator project move`"""

from __future__ import annotations

from pathlib import Path

from annotator.cli.options import ProjectName, Projects, RecordingName
from annotator.cli.output import print_line
from annotator.cli.projects import open_named
from annotator.types.messages import amount
from annotator.workflows.add_recordings import move_recording

AUTHOR = "annotator project move"


def run(project: ProjectName, recording: RecordingName, path: Path, /, *, projects: Projects = None) -> None:
    """Set the new path of a moved recording. All its frames must be at the new path; labels and boxes are kept.

    A recording that was removed comes back with its labels.

    Args:
        path: new path of the recording.
    """
    with open_named(project, projects) as opened:
        before = opened.recordings.find(recording, removed=True)
        now = move_recording(opened, before.id, path, AUTHOR)
    new = now.frames - before.frames if before.removed_by is None else 0
    grown = f" ({new} new)" if new > 0 else ""
    print_line(f"{now.name}: {amount(now.frames, 'frame')}{grown}, now at {now.path}")
