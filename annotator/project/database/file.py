"""The file that a store has opened: how it can be opened, and whether it is still the one on the disk.

Nothing here opens the database but SQLite: closing any other descriptor of it would drop SQLite's locks, which belong
to the process.
"""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path
from urllib.parse import quote

from annotator.types.errors import ProjectError, ReplacedError

WAL, SHARED_MEMORY, JOURNAL = "-wal", "-shm", "-journal"

Identity = tuple[int, ...]


def wal_of(path: Path) -> Path:
    """The `-wal` file of a database."""
    return path.with_name(path.name + WAL)


class DatabaseFile:
    """A database file, which exists, at the time when it was opened.

    A database that cannot be written is read without locks, which need a writable folder, unless another process
    with more rights has it open or has not closed it properly: then its latest changes are in the files beside it.

    Attributes:
        path: as given, for messages.
        place: the same, absolute; links are followed at each look, since one may be set to another project.
        is_writable: False on a read-only disk, or without the rights.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.place = path, path.absolute()
        self._require_regular()
        self.is_writable = os.access(self.place, os.W_OK) and os.access(self.place.parent, os.W_OK)
        # nothing but a replacement changes it
        self._is_fixed = not self.is_writable and not has_wal(self.place)
        # An inode is not used again while a connection has it open. SQLite keeps the files beside it while one is
        # open; without them, processes would not see each other's changes, and lose them.
        self._identities = {self.place: self._identity(self.place)}

    @property
    def address(self) -> str:
        """The URI for SQLite."""
        mode = "rw" if self.is_writable else "ro"
        return f"file:{quote(str(self.path.resolve()))}?mode={mode}" + ("&immutable=1" if self._is_fixed else "")

    def is_current(self) -> bool:
        """False if the file, or one of SQLite's files beside it, has been removed or replaced since it was opened."""
        return self._what_changed() is None

    def require_current(self) -> None:
        """Checks that the file is still the one on disk.

        Raises:
            ReplacedError: it is not.
        """
        if (path := self._what_changed()) is not None:
            what = "was replaced by another file" if path.exists() else "was removed"
            raise ReplacedError(
                f"{self.path.with_name(path.name)}: {what} while it was open, and nothing was saved in it since; "
                "reload the page, or start the command again, and repeat the latest change"
            )

    def remember(self) -> None:
        """Remembers SQLite's files beside the database; called when a connection has used it."""
        if self.is_writable:
            beside = (self.place.with_name(self.place.name + suffix) for suffix in (WAL, SHARED_MEMORY))
            self._identities |= {path: self._identity(path) for path in beside}

    def _what_changed(self) -> Path | None:
        return next((path for path, identity in self._identities.items() if self._identity(path) != identity), None)

    def _identity(self, path: Path) -> Identity | None:
        """Device and inode of a file, None if it is missing; of a fixed one, also what any writing changes."""
        try:
            found = path.stat()
        except OSError:
            return None
        identity = (found.st_dev, found.st_ino)
        return (*identity, found.st_size, found.st_mtime_ns, has_wal(path)) if self._is_fixed else identity

    def _require_regular(self) -> None:
        """Refuses pipes and devices in place of the database or of the files beside it: SQLite would wait."""
        for suffix in ("", WAL, SHARED_MEMORY, JOURNAL):
            path = self.place.with_name(self.place.name + suffix)
            with suppress(OSError):
                if not stat.S_ISREG(path.stat().st_mode):
                    raise ProjectError(f"{path}: is not a regular file; remove it")


def has_wal(path: Path) -> bool:
    """True if there are changes beside the database, or another process has it open."""
    try:
        wal = wal_of(path).stat()
    except OSError:
        return False
    return wal.st_size > 0 or path.with_name(path.name + SHARED_MEMORY).exists()
