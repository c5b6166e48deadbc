"""`annotator project copy`"""

from __future__ import annotations

from pathlib import Path

from annotator.cli.options import ModelsOption, Projects
from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.cli.projects import projects_root
from annotator.project import open_project
from annotator.project.backup.content import ModelChoice
from annotator.project.backup.take_in import copy_project


def run(
    folder: Path, name: str, /, *, models: ModelsOption[ModelChoice] = ModelChoice.ALL, projects: Projects = None
) -> None:
    """Make a project of a folder that somebody else has sent, without trusting it.

    Its database is verified, and only the regular files that a project consists of are copied: no links and no caches.

    Args:
        folder: the folder of the project.
        name: name of the new project.
    """
    with counted("copying files") as progress:
        path = copy_project(folder, projects_root(projects), name, models, progress)
    with open_project(path) as project:
        print_line(f"copied {folder} to {path}")
        for recording in project.recordings.all():
            state = "" if recording.path.exists() else " (not on this computer: annotator project move)"
            print_line(f"it reads the recording {recording.name} from {recording.path}{state}")
