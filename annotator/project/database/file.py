"""The file that a store has opened: how it can be opened, and whether it is still the one on disk.

Nothing here opens the file. Closing any descriptor of it would drop SQLite's locks, which belong to the process.
"""

from __future__ import annotations

import glob
import logging
import os
import sqlite3
import stat
import uuid
from contextlib import closing, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import quote

from annotator.files import sync_folder
from annotator.project.database.generation import Lineage
from annotator.types.errors import ProjectError, ReplacedError

WAL, SHARED_MEMORY, JOURNAL = "-wal", "-shm", "-journal"

Identity = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class DatabaseFile:
    """A database file at the time when it was opened.

    Attributes:
        path: as given, for messages.
        place: the same, absolute; links are followed at each look, since one may be set to another project.
        identity: its device and inode. An inode is not used again while a connection has it open.
        folder: those of its folder.
        is_writable: False on a read-only disk, or without the rights.
        is_fixed: True if nothing but a replacement changes it: it is read without SQLite's locks.
        beside: identities of SQLite's files beside it, by suffix, once they exist. SQLite keeps them while a
            connection is open; without them, processes would not see each other's changes, and lose them.
        lineage: of the content, since a copy can be written over the file.
    """

    path: Path
    place: Path
    identity: Identity | None
    folder: Identity | None
    is_writable: bool = True
    is_fixed: bool = False
    beside: dict[str, Identity | None] = field(default_factory=dict)
    lineage: Lineage = field(default_factory=Lineage)

    @property
    def address(self) -> str:
        """The URI for SQLite."""
        mode = "rw" if self.is_writable else "ro"
        return f"file:{quote(str(self.path.resolve()))}?mode={mode}" + ("&immutable=1" if self.is_fixed else "")

    def is_current(self) -> bool:
        """False if the file, or one of SQLite's files beside it, has been removed or replaced since it was opened."""
        return self._what_changed() is None

    def require_current(self) -> None:
        """Checks that the file is still the one on disk.

        Raises:
            ReplacedError: it is not.
        """
        if (path := self._what_changed()) is not None:
            what = "was replaced by another file, or written over," if path.exists() else "was removed"
            raise ReplacedError(
                f"{self.path.with_name(path.name)}: {what} while it was open, and nothing was saved in it since; "
                "reload the page, or start the command again, and repeat the latest change"
            )

    def is_replaced(self) -> bool:
        """True if the file itself has been removed or replaced."""
        return identity_of(self.place, self.is_fixed) != self.identity

    def is_same_folder(self) -> bool:
        """True if its folder is still the one in which it was opened."""
        return identity_of(self.place.parent) == self.folder

    def is_overwritten(self) -> bool:
        """True if another database was written over the file."""
        return self.is_writable and not self.is_replaced() and self.lineage.is_broken()

    def remember(self) -> None:
        """Remembers the content, and SQLite's files beside the database; called when a connection has used it."""
        if self.is_writable:
            self.lineage.begin(self.place)
        self.beside.update({suffix: identity_of(self.file_beside(suffix)) for suffix in (WAL, SHARED_MEMORY)})

    def left_beside(self) -> list[Path]:
        """SQLite's files beside the database that were there when it was opened."""
        known = [(self.file_beside(suffix), identity) for suffix, identity in self.beside.items()]
        return [path for path, identity in known if identity is not None and identity_of(path) == identity]

    def file_beside(self, suffix: str) -> Path:
        """SQLite's file of that suffix beside the database."""
        return self.place.with_name(self.place.name + suffix)

    def _what_changed(self) -> Path | None:
        if self.is_replaced():
            return self.place
        if not self.is_writable:
            return None
        known = ((self.file_beside(suffix), identity) for suffix, identity in self.beside.items())
        changed = next((path for path, identity in known if identity_of(path) != identity), None)
        return self.place if changed is None and self.lineage.is_broken() else changed


def database_file(path: Path) -> DatabaseFile:
    """The file at `path`, which exists.

    A database that cannot be written is read without locks, which need a writable folder, unless another process
    with more rights has it open or has not closed it properly: then its latest changes are in the files beside it.
    """
    place = path.absolute()
    _require_regular(place)
    is_writable = os.access(place, os.W_OK) and os.access(place.parent, os.W_OK)
    is_fixed = not is_writable and not _has_wal(place)
    identity, folder = identity_of(place, is_fixed), identity_of(place.parent)
    return DatabaseFile(path, place, identity, folder, is_writable, is_fixed)


def _require_regular(place: Path) -> None:
    """Refuses pipes and devices in place of the database or the files that SQLite reads beside it: it would wait."""
    for suffix in ("", WAL, SHARED_MEMORY, JOURNAL):
        path = place.with_name(place.name + suffix)
        with suppress(OSError):
            if not stat.S_ISREG(path.stat().st_mode):
                raise ProjectError(f"{path}: is not a regular file; remove it")


def identity_of(path: Path, is_fixed: bool = False) -> Identity | None:
    """The identity of a file, None if it is missing; if `is_fixed`, any writing changes it, too."""
    try:
        found = path.stat()
    except OSError:
        return None
    identity = (found.st_dev, found.st_ino)
    return (*identity, found.st_size, found.st_mtime_ns, _has_wal(path)) if is_fixed else identity


def _has_wal(path: Path) -> bool:
    """True if there are changes beside the database, or another process has it open."""
    try:
        wal = path.with_name(path.name + WAL).stat()
    except OSError:
        return False
    return wal.st_size > 0 or path.with_name(path.name + SHARED_MEMORY).exists()


# --- what a replaced database held ------------------------------------------------------------------------------------
# The process that has it open is the last that can read it.

LOG = logging.getLogger("annotator.project")

# Beside the projects: a file that appears in a folder would disturb those who remove or replace it.
FOLDER = ".replaced"


def keep_replaced(source: sqlite3.Connection, file: DatabaseFile) -> None:
    """Copies an open database whose file was removed or replaced, to `.replaced/PROJECT.until-TIME.db`.

    SQLite's files beside it that still belong to the old database are then removed, as SQLite would take them for
    those of the new one and mix both. If a copy was written over the file itself, the `-wal` is emptied: SQLite would
    move its content into the copy when the last connection is closed.
    """
    left = file.left_beside() if file.is_replaced() else []
    is_overwritten = file.is_overwritten()
    try:
        # of a file that was written over, only the pages in the `-wal` are still those of the old database
        kept = _copied(source, file.place.parent, is_overwritten)
    except (OSError, sqlite3.Error) as error:
        LOG.error("%s: was replaced, and what it held could not be kept: %s", file.path, error)
        for path in left:
            path.replace(path.with_name(f"{path.name}.of-replaced"))
        kept = None
    else:
        for path in left:
            path.unlink(missing_ok=True)
    if is_overwritten and file.lineage.has_left_wal():
        os.truncate(file.file_beside(WAL), 0)
    if kept is not None:
        LOG.warning("%s: was removed or replaced while it was open; what it held is kept in %s", file.path, kept)


def kept_copies(project: Path) -> list[Path]:
    """The copies of a project's database, the newest last."""
    return sorted((project.parent / FOLDER).glob(f"{glob.escape(project.name)}.until-*.db"))


def _copied(source: sqlite3.Connection, project: Path, is_checked: bool) -> Path | None:
    """The copy; None for a database without any event.

    Args:
        is_checked: whether to raise sqlite3.DatabaseError for a copy that is damaged.
    """
    (newest_ns,) = source.execute("SELECT max(time_ns) FROM events").fetchone()
    if newest_ns is None:
        return None
    folder = project.parent / FOLDER
    folder.mkdir(exist_ok=True)
    # named by its content, so that several processes that had it open keep one copy
    stamp = datetime.fromtimestamp(newest_ns // 10**9, UTC).strftime("%Y%m%dT%H%M%S")
    path = folder / f"{project.name}.until-{stamp}.{newest_ns % 10**9:09}.db"
    if path.exists():
        return path
    unfinished = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        # not for others, whatever the rights of the folder are
        unfinished.touch(0o600)
        with closing(sqlite3.connect(unfinished)) as target:
            source.backup(target)
            if is_checked and (found := target.execute("PRAGMA integrity_check(1)").fetchone()[0]) != "ok":
                raise sqlite3.DatabaseError(found)
        unfinished.replace(path)
        sync_folder(folder)
    finally:
        for suffix in ("", WAL, SHARED_MEMORY, "-journal"):
            unfinished.with_name(unfinished.name + suffix).unlink(missing_ok=True)
    return path
