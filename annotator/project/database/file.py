"""The file that a store has opened: how it can be opened, and whether it is still the one on disk.

Nothing here opens the file. Closing any descriptor of it would drop SQLite's locks, which belong to the process.
"""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

from annotator.project.backup.generation import Lineage
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
