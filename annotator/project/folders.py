"""Keeping projects tidy: recordings that are removed and come back, projects that are renamed or set aside."""

from __future__ import annotations

import os
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from annotator.files import lock_folder, private_folder, sync_folder
from annotator.project.config import BACKUPS, free_path, read_config, write_config
from annotator.types.errors import InUseError, ProjectError

# TODO-MERGED docstring of in_use.py:
# Tells other processes that a project is open: its folder is locked, shared by all who have it open.


def mark_in_use(opened: object, folder: Path) -> Callable[[], object]:
    """Marks the project in `folder` as open until the returned function is called, or `opened` is gone.

    Waits while another process renames or removes it. Without locks, as on Windows and some network disks, nothing is
    marked.
    """
    lock = lock_folder(folder, is_shared=True, waits=True)
    return (lambda: None) if lock is None else weakref.finalize(opened, os.close, lock)


@contextmanager
def not_in_use(folder: Path) -> Iterator[None]:
    """In the block, nobody has the project in `folder` open.

    Raises:
        InUseError: another process has it open.
    """
    try:
        lock = lock_folder(folder, is_told=True)
    except BlockingIOError:
        raise InUseError(
            f"{folder}: another process has this project open; if it is a server, use its start page, or stop it; "
            "if it is a command, wait until it is done"
        ) from None
    try:
        yield
    finally:
        if lock is not None:
            os.close(lock)


# TODO-MERGED docstring of folders.py:
# Renames a project's folder, or moves it aside.
#
# Both are one rename, which other processes notice: the store refuses to write to a database that is no longer at its
# place (`database.file`).


FOLDER = ".removed"


def set_aside(project: Path) -> Path:
    """Moves a project, which may be damaged, into the folder `.removed` beside it; returns its new folder.

    Raises:
        InUseError: another process has it open.
        ProjectError: it cannot be moved.
    """
    removed = project.parent / FOLDER
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S%fZ")
    aside = removed / f"{project.name}-{stamp}"
    try:
        with not_in_use(project):
            if not removed.exists():
                private_folder(removed)
            project.rename(aside)
        sync_folder(removed)
        sync_folder(project.parent)
    except OSError as error:
        raise ProjectError(f"{project}: cannot be moved to {removed}: {error.strerror}") from error
    return aside


def rename_project(project: Path, name: str) -> str:
    """Gives a project and the folder of its automatic backups another name, which it returns.

    Raises:
        ConfigError: an invalid name.
        InUseError: another process has it open.
        ProjectError: not a project, the name is taken, or the folder cannot be renamed.
    """
    read_config(project)
    path = free_path(project.parent, name)
    try:
        with not_in_use(project):
            # never replaces a folder with content, which another process may have made meanwhile
            project.rename(path)
            # nobody has it open; the folder's name counts, and a project with an old name in its settings is whole
            write_config(path, read_config(path).model_copy(update={"name": name}))
        sync_folder(project.parent)
        backups, renamed = (project.parent / BACKUPS / each for each in (project.name, name))
        if backups.is_dir() and not renamed.exists():
            backups.rename(renamed)
    except OSError as error:
        raise ProjectError(f"{project}: cannot be renamed to {name}: {error.strerror}") from error
    return name
