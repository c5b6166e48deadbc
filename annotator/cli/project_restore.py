"""`annotator project restore`"""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from annotator.cli.options import Projects
from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.cli.projects import projects_root
from annotator.project.backup.take_in import restore
from annotator.types.messages import amount


def run(file: Path, name: str | None = None, /, *, projects: Projects = None) -> None:
    """Make a project of a backup. All of it is checked first; an existing project is never replaced.

    Args:
        file: a file that `annotator project backup` or a server has written.
        name: name of the new project; default: that of the backup.
    """
    with counted("unpacking files") as progress:
        path, manifest = restore(file, projects_root(projects), name, progress)
    moment = datetime.fromtimestamp(manifest.created_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    labels, events = amount(manifest.labels, "label"), amount(manifest.events, "event")
    print_line(f"restored {path}: {labels}, {events}, as of {moment}")
