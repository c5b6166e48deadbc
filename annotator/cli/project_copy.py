"""`annotator project copy`"""

from __future__ import annotations

from pathlib import Path

from annotator.cli.options import ModelsOption, Projects, no_project, projects_root
from annotator.cli.output import counted, print_line
from annotator.project import open_project
from annotator.project.backup.content import ModelChoice
from annotator.project.backup.take_in import copy_project
from annotator.project.config import CONFIG_FILE
from annotator.types.errors import ConfigError


def run(
    source: str,
    name: str,
    /,
    *,
    without_labels: bool = False,
    models: ModelsOption[ModelChoice] = ModelChoice.ALL,
    projects: Projects = None,
) -> None:
    """Copy a project, or take in one that somebody else has sent, without trusting it.

    Its database is verified, and only the regular files that a project consists of are copied: no links and no caches.

    Args:
        source: name of a project, or the folder of one.
        name: name of the new project.
        without_labels: copy the recordings and the detectors only, no labels and boxes.
    """
    root = projects_root(projects)
    folder, is_sent = _folder(source, root)
    with counted("copying files") as progress:
        path = copy_project(folder, root, name, models, progress, labels=not without_labels, sent=is_sent)
    with open_project(path) as project:
        print_line(f"copied {folder} to {path}" + (" without its labels" if without_labels else ""))
        for recording in project.recordings.all():
            state = "" if recording.path.exists() else " (not on this computer: annotator project move)"
            print_line(f"it reads the recording {recording.name} from {recording.path}{state}")


def _folder(source: str, root: Path) -> tuple[Path, bool]:
    """The folder of a project that is given by its name or its path, and whether it is not one of those in `root`.

    Raises:
        ConfigError: there is none, or there are two.
    """
    path = Path(source)
    # as for `annotator check`: ./NAME is a path
    named = root / source if len(path.parts) == 1 and not source.startswith(".") else None
    places = [place for place in (path, named) if place is not None and (place / CONFIG_FILE).is_file()]
    if len(places) == 2 and not places[0].samefile(places[1]):
        raise ConfigError(f"{source} is both a folder and a project; write ./{source} or {named}")
    if not places and not path.exists() and (named is None or not named.exists()):
        raise ConfigError(f"{source}: no such folder, and {no_project(source, root)}")
    return (places[0], named not in places) if places else (path, True)
