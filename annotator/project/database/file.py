"""The file that a store has opened: how it can be opened, and whether it is still the one on disk.

Nothing here opens the file. Closing any descriptor of it would drop SQLite's locks, which belong to the process.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from annotator.types.errors import ReplacedError

WAL, SHARED_MEMORY = "-wal", "-shm"

Identity = tuple[int, ...]


@dataclass(frozen=True)
class DatabaseFile:
    """A database file at the time when it was opened.

    Attributes:
        path: as given, for messages.
        place: the same, absolute; links are followed at each look, since one may be set to another project.
        identity: its device and inode. An inode is not used again while a connection has it open.
        is_writable: False on a read-only disk, or without the rights.
        is_fixed: True if nothing but a replacement changes it: it is read without SQLite's locks.
    """

    path: Path
    place: Path
    identity: Identity | None
    is_writable: bool = True
    is_fixed: bool = False

    @property
    def address(self) -> str:
        """The URI for SQLite."""
        mode = "rw" if self.is_writable else "ro"
        return f"file:{quote(str(self.path.resolve()))}?mode={mode}" + ("&immutable=1" if self.is_fixed else "")

    def is_current(self) -> bool:
        """False if the file has been removed or replaced since it was opened."""
        return identity_of(self.place, self.is_fixed) == self.identity

    def require_current(self) -> None:
        """Checks that the file is still the one on disk.

        Raises:
            ReplacedError: it is not.
        """
        if not self.is_current():
            what = "was replaced by another file" if self.place.exists() else "was removed"
            raise ReplacedError(
                f"{self.path}: {what} while it was open, and nothing was saved in it since; "
                "reload the page, or start the command again, and repeat the latest change"
            )

    def beside(self, suffix: str) -> Path:
        """SQLite's file of that suffix beside the database."""
        return self.place.with_name(self.place.name + suffix)


def database_file(path: Path) -> DatabaseFile:
    """The file at `path`, which exists.

    A database that cannot be written is read without locks, which need a writable folder, unless another process
    with more rights has it open or has not closed it properly: then its latest changes are in the files beside it.
    """
    place = path.absolute()
    is_writable = os.access(place, os.W_OK) and os.access(place.parent, os.W_OK)
    is_fixed = not is_writable and not _has_wal(place)
    return DatabaseFile(path, place, identity_of(place, is_fixed), is_writable, is_fixed)


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
