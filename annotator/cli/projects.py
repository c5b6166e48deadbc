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
        ConfigError: there is no such project (the message lists the existing ones), or the name is a path.
    """
    from annotator.project import list_projects
    from annotator.project.config import check_name

    folder = projects_root(projects)
    try:
        check_name(name)
    except ConfigError as error:
        raise ConfigError(f"{error}; --projects names the folder of projects") from error
    if not (folder / name).is_dir():
        known = ", ".join(project.path.name for project in list_projects(folder)) or "none"
        raise ConfigError(
            f"{folder} has no project {name!r} (it has: {known}); "
            f"create it with `annotator new {name} --classes ...`, or name another folder with --projects"
        )
    return folder / name
