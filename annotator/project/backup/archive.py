"""Backup files: a zip of a project's files, with a manifest of their sizes and SHA-256 hashes as its last entry."""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import zipfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from annotator.files import ARCHIVE_ERRORS, CHUNK_BYTES, open_file
from annotator.project.backup.content import ModelChoice, is_content
from annotator.project.config import CONFIG_FILE
from annotator.project.database.store import DATABASE_FILE
from annotator.types.errors import FormatError

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
    """Adds a file to an archive that is being written.

    Raises:
        OSError: it cannot be read, or the archive cannot be written.
    """
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
    """Opens a backup and checks the names, kinds and sizes of all entries.

    Raises:
        FormatError: no regular file, not a backup, damaged, of a newer annotator, or with entries that no backup has.
    """
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
    """The manifest of a backup.

    Raises:
        FormatError: as `open_backup`.
    """
    with open_backup(path) as (_, manifest):
        return manifest


def unpack(path: Path, archive: zipfile.ZipFile, manifest: BackupManifest, folder: Path, progress: Progress) -> None:
    """Unpacks a backup into an empty folder; each file's size and hash must be right.

    Raises:
        FormatError: the disk has too little space, or an entry is damaged or differs from the manifest.
    """
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
