"""`annotator project backup`"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from annotator.cli.options import ModelsOption, ProjectName, Projects
from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.cli.projects import named_folder
from annotator.project.backup.content import ModelChoice
from annotator.project.backup.make import back_up
from annotator.types.messages import amount, first_few

# Files that a message lists.
MOST_NAMED = 5


def run(
    project: ProjectName,
    file: Path | None = None,
    /,
    *,
    models: ModelsOption[ModelChoice] = ModelChoice.ALL,
    projects: Projects = None,
) -> None:
    """Write a backup of a project, as of one moment, while a server or a job may go on writing.

    The file holds settings, database, images of pseudo-views and detectors, with their hashes. It does not hold the
    recordings.

    Args:
        file: the file to write; default: PROJECT-TIME.zip in this folder.
    """
    moment = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    out = Path(f"{project}-{moment}.zip") if file is None else file
    with counted("copying files") as progress:
        backup = back_up(named_folder(project, projects), out, models, progress=progress)
    manifest = backup.manifest
    labels, events = amount(manifest.labels, "label"), amount(manifest.events, "event")
    print_line(f"{out}: {labels}, {events}, {amount(len(manifest.files), 'file')}")
    print_missing(backup.missing)
    print_line(f"restore it with: annotator project restore {out} NAME")


def print_missing(names: Sequence[str]) -> None:
    """Names the files that a project refers to, and that are not there."""
    if names:
        files = first_few(names, MOST_NAMED)
        print_line(f"the project lacks {amount(len(names), 'file')} of its pseudo-views or detectors: {files}")
