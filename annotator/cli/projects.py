"""Opens a project by name."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from annotator.types.errors import ConfigError

if TYPE_CHECKING:
    from annotator.project import Project

ENVIRONMENT = "ANNOTATOR_PROJECTS"
DEFAULT_ROOT = Path("projects")


def projects_root(projects: Path | None) -> Path:
    """The folder of projects: as given, else ANNOTATOR_PROJECTS, else `projects` in the current folder."""
    if projects is not None:
        return projects
    return Path(os.environ.get(ENVIRONMENT) or DEFAULT_ROOT)


def open_named(name: str, projects: Path | None) -> Project:
    """Opens the project of this name.

    Raises:
        ConfigError: as `named_folder`.
        ProjectError: the project cannot be opened.
    """
    # imported here, so that `annotator doctor` runs without the database's package
    from annotator.project import open_project

    return open_project(named_folder(name, projects))


def named_folder(name: str, projects: Path | None) -> Path:
    """The folder of the project of this name, which may be damaged.

    Raises:
        ConfigError: there is no such project (the message names the one that is probably meant, or those that exist),
            or the name is a path.
    """
    from annotator.project.config import check_name

    folder = projects_root(projects)
    try:
        check_name(name)
    except ConfigError as error:
        if len(Path(name).parts) != 1:
            raise ConfigError(f"{error}; --projects names the folder of projects") from error
        raise ConfigError(no_project(name, folder)) from error
    if not (folder / name).is_dir():
        raise ConfigError(
            f"{no_project(name, folder)}; `annotator new` creates one, and --projects names another folder"
        )
    return folder / name


def no_project(name: str, folder: Path) -> str:
    """Says that a folder of projects has none of this name, and which is probably meant."""
    from annotator.project import list_projects
    from annotator.types.messages import alternatives

    others = alternatives(name, [each.path.name for each in list_projects(folder)])
    return f"{folder} has no project {name!r} ({others})"
