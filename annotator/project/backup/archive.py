"""Backup files: a zip of a project's files, with a manifest of their sizes and SHA-256 hashes as its last entry."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import sqlite3
import stat
import zipfile
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from annotator.files import ARCHIVE_ERRORS, CHUNK_BYTES, link_out, open_file
from annotator.project.config import CONFIG_FILE
from annotator.project.database.store import DATABASE_FILE
from annotator.types.errors import FormatError, ProjectError

# --- the files of a project -------------------------------------------------------------------------------------------

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
    """The files that a database refers to."""
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
    """Removes the other detectors from a copy of a database."""
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


MANIFEST = "manifest.json"
VERSION = 1
MOST_FILES = 2_000_000
_MANIFEST_BYTES = 2**29
_HASH = r"^[0-9a-f]{64}$"

Progress = Callable[[int, int], None]
"""Called with (files done, files)."""


class BackupFile(BaseModel):
    """A file in a backup: its path in the project's folder, its size, and its SHA-256 hash (hex)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    path: str
    bytes: int = Field(ge=0)
    sha256: str = Field(pattern=_HASH)


class BackupManifest(BaseModel):
    """What a backup contains.

    Attributes:
        format, version: of this file.
        project: name of the project's folder.
        annotator: version of the program that wrote it.
        created_ns: UTC nanoseconds since the epoch.
        database_version: of `project.db`.
        last_event: id of the newest event; 0 = none.
        events, labels: numbers of rows.
        models: the detectors in it.
        files: all files but this one.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: Literal["annotator-backup"] = "annotator-backup"
    version: int = Field(VERSION, ge=1)
    project: str
    annotator: str
    created_ns: int = Field(ge=0)
    database_version: int
    last_event: int = Field(ge=0)
    events: int = Field(ge=0)
    labels: int = Field(ge=0)
    models: ModelChoice
    files: Annotated[tuple[BackupFile, ...], Field(max_length=MOST_FILES)]

    @property
    def bytes(self) -> int:
        """Size of all files, unpacked."""
        return sum(file.bytes for file in self.files)


def add_file(archive: zipfile.ZipFile, name: str, path: Path, *, packed: bool = False) -> BackupFile:
    """Adds a file to an archive that is being written."""
    info = zipfile.ZipInfo(name)
    info.compress_type = zipfile.ZIP_DEFLATED if packed else zipfile.ZIP_STORED
    info._compresslevel = 1  # type: ignore[attr-defined] # `ZipFile.open` has no argument for it
    info.external_attr = (stat.S_IFREG | 0o600) << 16
    with open_file(path) as source, archive.open(info, "w", force_zip64=True) as target:
        size, sha256 = _copy(source.read, target.write)
    return BackupFile(path=name, bytes=size, sha256=sha256)


def add_manifest(archive: zipfile.ZipFile, manifest: BackupManifest) -> None:
    """Adds the manifest, which completes the archive."""
    info = zipfile.ZipInfo(MANIFEST)
    info.compress_type, info.external_attr = zipfile.ZIP_DEFLATED, (stat.S_IFREG | 0o600) << 16
    archive.writestr(info, manifest.model_dump_json(indent=1))


@contextmanager
def open_backup(path: Path) -> Iterator[tuple[zipfile.ZipFile, BackupManifest]]:
    """Opens a backup and checks the names, kinds and sizes of all entries."""
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


def unpack(path: Path, archive: zipfile.ZipFile, manifest: BackupManifest, folder: Path, progress: Progress) -> None:
    """Unpacks a backup into an empty folder; each file's size and hash must be right."""
    free = shutil.disk_usage(folder).free
    if manifest.bytes > free:
        raise FormatError(path, f"needs {manifest.bytes >> 20} MiB, but {folder.parent} has {free >> 20} MiB left")
    for number, file in enumerate(manifest.files, 1):
        target = folder / file.path
        target.parent.mkdir(parents=True, exist_ok=True)
        with _reported(path), archive.open(file.path) as source, target.open("xb") as out:
            size, sha256 = _copy(source.read, out.write, file.bytes)
        if (size, sha256) != (file.bytes, file.sha256):
            raise FormatError(path, f"{file.path} is damaged: its size or hash differs from the manifest")
        progress(number, len(manifest.files))


def sync_files(folder: Path) -> None:
    """Makes the new files in a folder durable: all at once, which is much faster for thousands of small files."""
    if hasattr(os, "sync"):
        os.sync()
        return
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb+") as file:
                os.fsync(file.fileno())


def _copy(read: Callable[[int], bytes], write: Callable[[bytes], object], limit: int | None = None) -> tuple[int, str]:
    """Copies at most a little more than `limit` bytes; returns their number and hash."""
    size, digest = 0, hashlib.sha256()
    while (limit is None or size <= limit) and (chunk := read(CHUNK_BYTES)):
        write(chunk)
        digest.update(chunk)
        size += len(chunk)
    return size, digest.hexdigest()


def _read_manifest(path: Path, archive: zipfile.ZipFile) -> BackupManifest:
    infos = [info for info in archive.infolist() if info.filename == MANIFEST]
    if not infos or infos[0].file_size > _MANIFEST_BYTES:
        raise FormatError(path, f"is not a backup of a project: it has no {MANIFEST}")
    with archive.open(infos[0]) as file:
        content = file.read(_MANIFEST_BYTES)
    try:
        version = _Version.model_validate_json(content).version
        if version > VERSION:
            raise FormatError(path, f"has backup version {version}; this annotator reads up to {VERSION}; update it")
        return BackupManifest.model_validate_json(content)
    except ValidationError as error:
        detail = error.errors()[0]
        raise FormatError(path, f"{MANIFEST} is not that of a backup: {detail['loc']}: {detail['msg']}") from error


class _Version(BaseModel):
    version: int


def _check_entries(path: Path, archive: zipfile.ZipFile, manifest: BackupManifest) -> None:
    """Refuses every entry that is not one of the manifest's regular files of its size."""
    sizes = {file.path: file.bytes for file in manifest.files}
    infos = {info.filename: info for info in archive.infolist()}
    if len(infos) != len(archive.infolist()) or len(sizes) != len(manifest.files):
        raise FormatError(path, "contains a file twice")
    for name in sizes:
        if not is_content(name):
            raise FormatError(path, f"contains {name[:80]!r}, which is no file of a project")
    if missing := sorted({CONFIG_FILE, DATABASE_FILE} - sizes.keys()):
        raise FormatError(path, f"contains no {missing[0]}")
    for name, info in infos.items():
        if name != MANIFEST and name not in sizes:
            raise FormatError(path, f"contains {name[:80]!r}, which its manifest does not list")
        if stat.S_IFMT(info.external_attr >> 16) not in (0, stat.S_IFREG) or info.is_dir():
            raise FormatError(path, f"contains {name[:80]!r}, which is a link, a device or a folder")
        if name != MANIFEST and info.file_size != sizes[name]:
            raise FormatError(path, f"{name[:80]!r} has another size than its manifest says")
    if lacking := sorted(sizes.keys() - infos.keys()):
        raise FormatError(path, f"lacks {lacking[0]!r}, which its manifest lists")


@contextmanager
def _reported(path: Path) -> Iterator[None]:
    """Converts the errors of a damaged archive into a FormatError."""
    try:
        yield
    except ARCHIVE_ERRORS as error:
        raise FormatError(path, f"cannot be read as a backup: {error}") from error
