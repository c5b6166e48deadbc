"""`annotator project remove`"""

from __future__ import annotations

from pathlib import Path

from annotator.cli.options import ProjectName, Projects, Yes
from annotator.cli.output import print_line, require_yes
from annotator.cli.projects import named_folder, open_named
from annotator.project import open_project
from annotator.project.tidying.folders import set_aside
from annotator.types.errors import AnnotatorError
from annotator.types.messages import amount

AUTHOR = "annotator project remove"


def run(project: ProjectName, recording: str | None = None, /, *, yes: Yes = False, projects: Projects = None) -> None:
    """Remove a recording from a project, or a whole project. Nothing is deleted.

    The labels of a removed recording stay in the project's history. They come back when it is added again. A removed
    project is moved to the folder `.removed` beside the projects, where you can delete it.

    Args:
        recording: name of the recording; default: the whole project.
    """
    if recording is None:
        _whole(project, yes, projects)
        return
    with open_named(project, projects) as opened:
        stored = opened.recordings.find(recording)
        labels = amount(opened.recordings.label_counts().get(stored.id, 0), "label")
        require_yes(f"Remove {recording} from {project}, with {labels}? Adding it again brings back its labels.", yes)
        opened.recordings.remove(stored.id, AUTHOR)
    print_line(f"removed {recording} with {labels}; its files are unchanged")
    words = f"annotator add {project} {stored.path}"
    print_line(f"bring it back with: {words}" + (", and the options it was added with" if stored.options else ""))


def _whole(name: str, yes: bool, projects: Projects) -> None:
    folder = named_folder(name, projects)
    require_yes(f"Remove the project {name}{_content(folder)}? It is moved to {folder.parent / '.removed'}.", yes)
    aside = set_aside(folder)
    print_line(f"moved {folder} to {aside}; delete that folder to free its space")
    print_line(f"bring it back with: annotator project copy {aside} {name}")


def _content(folder: Path) -> str:
    """Such as " (recordings: 2, labels: 14)"; "" for a damaged project, which can be removed, too."""
    try:
        with open_project(folder) as opened:
            counts = opened.statistics()
    except AnnotatorError:
        return ""
    return f" (recordings: {counts.recordings}, labels: {counts.labels.total})"
