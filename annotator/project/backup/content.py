"""The files that a project consists of."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path, PurePosixPath

from annotator.files import link_out
from annotator.project.config import CONFIG_FILE
from annotator.project.database.store import DATABASE_FILE
from annotator.types.errors import ProjectError

MODELS_FOLDER, VIEWS_FOLDER = "models", "views"
VIEW_FILE = re.compile(r"([0-9a-f]{64})\.png")
# Files of a trained detector: weights, records, and pictures in subfolders; no hidden ones.
_PART = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")
# A training set, which the next training replaces, and networks converted for this machine.
_REMADE = re.compile(r"dataset|.*-(openvino|onnxruntime)-[0-9a-f]+")
_MOST_PARTS = 6


class ModelChoice(StrEnum):
    """The detectors that go into a copy of a project."""

    ALL = "all"
    ACTIVE = "active"
    NONE = "none"


def is_content(name: str) -> bool:
    """Whether a project may contain a file of this path, relative to its folder, with slashes."""
    if name in (CONFIG_FILE, DATABASE_FILE):
        return True
    parts = name.split("/")
    if parts[0] == VIEWS_FOLDER:
        return len(parts) == 2 and VIEW_FILE.fullmatch(parts[1]) is not None
    if parts[0] != MODELS_FOLDER or not 2 <= len(parts) <= _MOST_PARTS:
        return False
    return all(_PART.fullmatch(part) and not _REMADE.fullmatch(part) for part in parts)


@dataclass(frozen=True)
class StoredFiles:
    """Files that a database refers to, relative to the project's folder, with slashes.

    Attributes:
        views: images of pseudo-views.
        models: by id, the weights, and the manifest where it has one.
        outside: paths of model files that are not in the project's folder.
        hashes: SHA-256 of weights, by their path.
    """

    views: tuple[str, ...]
    models: dict[int, tuple[str, ...]]
    outside: tuple[str, ...]
    hashes: dict[str, str]

    def not_in(self, found: Collection[str]) -> tuple[str, ...]:
        """Those files of the project that are not among the found ones."""
        named = [*self.views, *(name for names in self.models.values() for name in names)]
        return tuple(name for name in dict.fromkeys(named) if name not in found)


def stored_files(connection: sqlite3.Connection) -> StoredFiles:
    """The files that a database refers to.

    Raises:
        sqlite3.Error: it cannot be read.
    """
    # changes of the classes have an id of no view
    of_views = "SELECT DISTINCT view_id FROM events WHERE view_id IS NOT NULL AND view_id <> 'classes' ORDER BY view_id"
    ids = connection.execute(of_views)
    views = tuple(f"{VIEWS_FOLDER}/{row[0]}.png" for row in ids)
    models: dict[int, tuple[str, ...]] = {}
    outside = []
    hashes: dict[str, str] = {}
    for model_id, sha256, path, manifest in connection.execute(
        "SELECT id, sha256, path, manifest FROM models ORDER BY id"
    ):
        names = [str(name) for name in (path, manifest) if name is not None]
        models[model_id] = tuple(filter(is_content, names))
        outside += [name for name in names if not is_content(name)]
        # a training may have replaced the weights of an earlier one: the newest row counts
        hashes[str(path)] = str(sha256)
    return StoredFiles(views, models, tuple(outside), hashes)


def keep_models(database: Path, choice: ModelChoice) -> None:
    """Removes the other detectors from a copy of a database.

    Raises:
        sqlite3.Error: it cannot be written.
    """
    if choice is ModelChoice.ALL:
        return
    with closing(sqlite3.connect(database, isolation_level=None)) as connection:
        connection.execute("DELETE FROM models" + (" WHERE active = 0" if choice is ModelChoice.ACTIVE else ""))


def folder_files(folder: Path, stored: StoredFiles) -> Iterator[str]:
    """Yields the paths of all files of the project that exist: settings, views, and the folders of its models.

    Links, devices and files that do not belong to a project are left out.
    """
    yield CONFIG_FILE
    yield from (name for name in stored.views if is_content(name) and is_regular(folder, name))
    named = {name for names in stored.models.values() for name in names}
    found = {name for name in named if is_regular(folder, name)}
    # a training's folder is models/ROLE/RUN
    for run in {str(PurePosixPath(name).parent) for name in named if name.count("/") >= 3}:
        found.update(_files_in(folder, run))
    yield from sorted(found)


def require_own_files(project: Path) -> None:
    """Refuses a project with links that lead out of it: somebody may have sent it, to read or replace other files.

    Raises:
        ProjectError: the message names the link.
    """
    try:
        # images of views are many; who reads one refuses a link
        link = link_out(project, VIEWS_FOLDER)
    except OSError as error:
        raise ProjectError(f"{error.filename}: cannot be read: {error.strerror}") from error
    if link is not None:
        raise ProjectError(
            f"{link}: is a link that leads out of the project, which has all its files in its own folder; remove the "
            "link, or put what it leads to in its place"
        )


def is_regular(folder: Path, name: str) -> bool:
    """Whether a path inside a folder is a regular file, with no link on the way to it."""
    place = folder
    for part in PurePosixPath(name).parts:
        place = place / part
        if place.is_symlink():
            return False
    return place.is_file()


def _files_in(folder: Path, run: str) -> Iterator[str]:
    place = folder / run
    if place.is_symlink() or not place.is_dir():
        return
    for child in place.iterdir():
        name = f"{run}/{child.name}"
        if child.is_symlink() or not is_content(name if child.is_file() else f"{name}/file"):
            continue
        if child.is_dir():
            yield from _files_in(folder, name)
        elif is_regular(folder, name):
            yield name
