"""Backup files: a zip of a project's files, with a manifest as its last entry."""

from __future__ import annotations

import re
import shutil
import sqlite3
import stat
import zipfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path, PurePosixPath
from typing import Literal

from pydantic import Field, ValidationError

from annotator.files import ARCHIVE_ERRORS, CHUNK_BYTES, link_out, open_file
from annotator.project.config import CONFIG_FILE
from annotator.project.database.store import DATABASE_FILE, explained
from annotator.types.bases import FileRecord
from annotator.types.errors import FormatError, ProjectError
from annotator.types.messages import amount, first_problem

# --- the files of a project -------------------------------------------------------------------------------------------

MODELS_FOLDER, VIEWS_FOLDER = "models", "views"
_VIEW = re.compile(r"[0-9a-f]{64}\.png")
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
        return len(parts) == 2 and _VIEW.fullmatch(parts[1]) is not None
    if parts[0] != MODELS_FOLDER or not 2 <= len(parts) <= _MOST_PARTS:
        return False
    return all(_PART.fullmatch(part) and not _REMADE.fullmatch(part) for part in parts)


@dataclass(frozen=True)
class StoredFiles:
    """Files that a database refers to.

    Attributes:
        names: images of pseudo-views, weights and manifests of detectors, relative to the project's folder.
        outside: paths that are not those of a project's files.
        hashes: SHA-256 of images and weights, by their names.
    """

    names: tuple[str, ...]
    outside: tuple[str, ...]
    hashes: dict[str, str]


def stored_files(connection: sqlite3.Connection) -> StoredFiles:
    """The files that a database refers to."""
    # changes of the classes have an id of no view
    of_views = "SELECT DISTINCT view_id FROM events WHERE view_id IS NOT NULL AND view_id <> 'classes' ORDER BY view_id"
    hashes = {f"{VIEWS_FOLDER}/{row[0]}.png": str(row[0]) for row in connection.execute(of_views)}
    names = list(hashes)
    for sha256, *paths in connection.execute("SELECT sha256, path, manifest FROM models ORDER BY id"):
        names += [str(path) for path in paths if path is not None]
        # a training may have replaced the weights of an earlier one: the newest row counts
        hashes[str(paths[0])] = str(sha256)
    outside = tuple(name for name in names if not is_content(name))
    return StoredFiles(tuple(name for name in dict.fromkeys(names) if is_content(name)), outside, hashes)


def keep_models(database: Path, choice: ModelChoice) -> None:
    """Removes the other detectors from a copy of a database."""
    if choice is ModelChoice.ALL:
        return
    with explained(database), closing(sqlite3.connect(database, isolation_level=None)) as connection:
        connection.execute("DELETE FROM models" + (" WHERE active = 0" if choice is ModelChoice.ACTIVE else ""))


def folder_files(folder: Path, stored: StoredFiles) -> list[str]:
    """The paths of all files of the project that exist: settings, views, and the folders of its models.

    Links, devices and files that do not belong to a project are left out.
    """
    found = {name for name in stored.names if is_regular(folder, name)}
    # a training's folder is models/ROLE/RUN
    for run in {str(PurePosixPath(name).parent) for name in stored.names if name.count("/") >= 3}:
        found.update(_files_in(folder, run))
    return [CONFIG_FILE, *sorted(found)]


def require_own_files(project: Path) -> None:
    """Refuses a project with links that lead out of it: somebody may have sent it, to read or replace other files."""
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


# --- the zip file -----------------------------------------------------------------------------------------------------

MANIFEST = "manifest.json"
VERSION = 1
_MANIFEST_BYTES = 2**20

Progress = Callable[[int, int], None]
"""Called with (files done, files)."""


class BackupManifest(FileRecord):
    """What a backup contains.

    Attributes:
        format, version: of this file.
        project: name of the project's folder.
        annotator: version of the program that wrote it.
        created_ns: UTC nanoseconds since the epoch.
        last_event: id of the newest event; 0 = none.
        labels: number of them.
        count: number of files, without this one.
    """

    format: Literal["annotator-backup"] = "annotator-backup"
    version: int = Field(VERSION, ge=1)
    project: str
    annotator: str
    created_ns: int = Field(ge=0)
    last_event: int = Field(ge=0)
    labels: int = Field(ge=0)
    count: int = Field(ge=0)


def add_file(archive: zipfile.ZipFile, name: str, path: Path, *, packed: bool = False) -> None:
    """Adds a file to an archive that is being written."""
    info = _entry(name, packed)
    info._compresslevel = 1  # type: ignore[attr-defined] # `ZipFile.open` has no argument for it
    with open_file(path) as source, archive.open(info, "w", force_zip64=True) as target:
        shutil.copyfileobj(source, target, CHUNK_BYTES)


def add_manifest(archive: zipfile.ZipFile, manifest: BackupManifest) -> None:
    """Adds the manifest, which completes the archive."""
    archive.writestr(_entry(MANIFEST, True), manifest.model_dump_json(indent=1))


def _entry(name: str, packed: bool) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name)
    info.compress_type = zipfile.ZIP_DEFLATED if packed else zipfile.ZIP_STORED
    info.external_attr = (stat.S_IFREG | 0o600) << 16
    return info


@contextmanager
def open_backup(path: Path) -> Iterator[tuple[zipfile.ZipFile, BackupManifest]]:
    """Opens a backup and checks the names and kinds of all entries."""
    if not path.is_file():
        if path.is_dir():
            raise FormatError(path, "is a folder; `annotator project copy` takes in a project's folder")
        raise FormatError(path, "no such file; give a file that `annotator project backup` has written")
    with ExitStack() as opened:
        with _reported(path):
            # its list of files may be long: a project has an image for each view
            archive = opened.enter_context(zipfile.ZipFile(opened.enter_context(open_file(path))))
            manifest = _read_manifest(path, archive)
            _check_entries(path, archive, manifest)
        yield archive, manifest


def read_manifest(path: Path) -> BackupManifest:
    """The manifest of a backup."""
    with open_backup(path) as (_, manifest):
        return manifest


def unpack(path: Path, archive: zipfile.ZipFile, folder: Path, progress: Progress) -> None:
    """Unpacks a backup into an empty folder; each file's checksum must be right."""
    infos = [info for info in archive.infolist() if info.filename != MANIFEST]
    needed, free = sum(info.file_size for info in infos), shutil.disk_usage(folder).free
    if needed > free:
        raise FormatError(path, f"needs {needed >> 20} MiB, but {folder.parent} has {free >> 20} MiB left")
    for number, info in enumerate(infos, 1):
        target = folder / info.filename
        target.parent.mkdir(parents=True, exist_ok=True)
        with _reported(path), archive.open(info) as source, target.open("xb") as out:
            shutil.copyfileobj(source, out, CHUNK_BYTES)
        progress(number, len(infos))


def _read_manifest(path: Path, archive: zipfile.ZipFile) -> BackupManifest:
    infos = [info for info in archive.infolist() if info.filename == MANIFEST]
    if not infos or infos[0].file_size > _MANIFEST_BYTES:
        raise FormatError(path, f"is not a backup of a project: it has no {MANIFEST}")
    with archive.open(infos[0]) as file:
        content = file.read()
    try:
        manifest = BackupManifest.model_validate_json(content)
    except ValidationError as error:
        raise FormatError(path, f"{MANIFEST} is not that of a backup: {first_problem(error)}") from error
    if manifest.version > VERSION:
        raise FormatError(path, f"has version {manifest.version}; this annotator reads up to {VERSION}; update it")
    return manifest


def _check_entries(path: Path, archive: zipfile.ZipFile, manifest: BackupManifest) -> None:
    """Refuses every entry that is not a regular file of a project."""
    infos = {info.filename: info for info in archive.infolist() if info.filename != MANIFEST}
    if len(infos) + 1 != len(archive.infolist()):
        raise FormatError(path, "contains a file twice")
    for name, info in infos.items():
        if not is_content(name):
            raise FormatError(path, f"contains {name[:80]!r}, which is no file of a project")
        if stat.S_IFMT(info.external_attr >> 16) not in (0, stat.S_IFREG):
            raise FormatError(path, f"contains {name[:80]!r}, which is a link or a device")
    if missing := sorted({CONFIG_FILE, DATABASE_FILE} - infos.keys()):
        raise FormatError(path, f"contains no {missing[0]}")
    if len(infos) != manifest.count:
        raise FormatError(path, f"contains {amount(len(infos), 'file')}, but should have {manifest.count}")


@contextmanager
def _reported(path: Path) -> Iterator[None]:
    """Converts the errors of a damaged archive into a FormatError."""
    try:
        yield
    except ARCHIVE_ERRORS as error:
        raise FormatError(path, f"cannot be read as a backup: {error}") from error
