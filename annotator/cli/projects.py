"""Which project a command means."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import tyro

from annotator.project import Project, list_projects, open_project
from annotator.project.config import check_name
from annotator.types.errors import ConfigError

ENVIRONMENT = "ANNOTATOR_PROJECTS"
DEFAULT_ROOT = Path("projects")

Root = Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint="")]


def projects_root(root: Path | None) -> Path:
    """The folder of projects: as given, else as the environment says now, else `projects` in the current folder."""
    if root is not None:
        return root
    return Path(os.environ.get(ENVIRONMENT) or DEFAULT_ROOT)


def open_named(name: str, root: Path | None) -> Project:
    """The project of that name.

    Raises:
        ConfigError: there is none, and the message lists those there are; or it is a path and no name.
        ProjectError: it cannot be opened.
    """
    folder = projects_root(root)
    try:
        check_name(name)
    except ConfigError as error:
        raise ConfigError(f"no project is called that: {error}; a folder of projects is named with --root") from error
    if not (folder / name).is_dir():
        known = ", ".join(project.path.name for project in list_projects(folder)) or "none"
        raise ConfigError(
            f"{folder} has no project {name!r} (there: {known}); "
            f"create it with `annotator new {name} --classes ...`, or name the folder of projects with --root"
        )
    return open_project(folder / name)
