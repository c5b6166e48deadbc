"""The file that a store has opened: how it can be opened, and whether it, and its `-wal`, are still the right ones.

SQLite keeps the latest transactions in `project.db-wal`. If a process is killed, this file stays, and SQLite applies it
to whatever `project.db` it finds when the database is opened next: also to an older copy that somebody has put there.
The result is a newer state than that of the copy, or a damaged database. SQLite's own headers do not prevent this.

So each write transaction stores a new token and the token of the transaction before it (table `generation`). A `-wal`
belongs to a database if the token in `project.db` is one of those in the `-wal`, or the one before its first. A token
consists of a number, one more than that of the token before, and of random digits: the greater text is the newer one.

Nothing here opens the database but SQLite: closing any other descriptor of it would drop SQLite's locks, which belong
to the process.
"""

from __future__ import annotations

import os
import re
import sqlite3
import stat
import struct
import time
from contextlib import closing, suppress
from pathlib import Path
from urllib.parse import quote

from sqlalchemy import Connection

from annotator.files import open_file
from annotator.types.errors import ProjectError, ReplacedError

WAL = "-wal"
_NO_TOKEN = "0" * 32
# Digits of a token that are its number.
_NUMBER = 16
# Looks that must find a foreign file, and the time between them: another process may write between two readings.
_LOOKS, _LOOKS_AGAIN_AFTER_S = 4, 0.05
_ADVANCE = (
    "UPDATE generation SET chain = 'annotator-generation ' || substr(chain, -32) || ' ' "
    "|| printf('%016d', CAST(substr(chain, -32, 16) AS INTEGER) + 1) || lower(hex(randomblob(8)))"
)
_CHAIN = re.compile(rb"annotator-generation ([0-9a-f]{32}) ([0-9a-f]{32})")
# SQLite's file format, sections 1.6, 4.1 and 4.2: sizes of pages, and of the headers of a WAL and of its frames, the
# two magic numbers, the beginning of a page of a table, and the number of its rows.
_PAGE_BYTES = {2**power for power in range(9, 17)}
_HEADER, _FRAME_HEADER, _MAGIC = 32, 24, (0x377F0682, 0x377F0683)
_TABLE_LEAF, _ONE_ROW = 0x0D, b"\0\1"


def advance(connection: Connection) -> str:
    """Stores a new token, within the caller's write transaction, and returns it."""
    connection.exec_driver_sql(_ADVANCE)
    return str(connection.exec_driver_sql("SELECT substr(chain, -32) FROM generation").scalar_one())


def has_foreign_wal(path: Path) -> bool:
    """True if the `-wal` file beside the database `path` belongs to another database, or to another state of it.

    False for a database that cannot be read: SQLite reports what is wrong with it.
    """
    for look in range(_LOOKS):
        if look:
            time.sleep(_LOOKS_AGAIN_AFTER_S)
        # in this order: what is moved into the database meanwhile is still in the `-wal`, unless it is begun anew
        token, fitting = _token(path, "mode=ro&immutable=1"), _fitting_tokens(wal_of(path))
        if fitting is None or token is None or token in fitting:
            return False
    return True


def require_own_wal(path: Path) -> None:
    """Refuses a database with a `has_foreign_wal`."""
    if has_foreign_wal(path):
        raise ProjectError(
            f"{path}: does not belong to the file {wal_of(path).name} beside it; probably it is a copy that was put "
            "there by hand, and the other file is left from another state; nothing was changed. `annotator project "
            "repair` makes a new project of it without that file"
        )


def wal_of(path: Path) -> Path:
    """The `-wal` file of a database."""
    return path.with_name(path.name + WAL)


def _fitting_tokens(wal: Path) -> set[str] | None:
    """The tokens of the databases to which a WAL can be applied; None if there is none, or SQLite would ignore it."""
    chain, has_commits = list[tuple[bytes, bytes]](), False
    try:
        with open_file(wal) as file:
            header = file.read(_HEADER)
            page_bytes, salts = int.from_bytes(header[8:12], "big"), header[16:24]
            if int.from_bytes(header[:4], "big") not in _MAGIC or page_bytes not in _PAGE_BYTES:
                return None
            size = _FRAME_HEADER + page_bytes
            # what follows other salts is left from before the file was begun anew; page 0 is none
            while len(frame := file.read(size)) == size and frame[8:16] == salts and any(frame[:4]):
                has_commits |= any(frame[4:8])
                page = frame[_FRAME_HEADER:]
                if page[0] == _TABLE_LEAF and page[3:5] == _ONE_ROW:
                    (cell,) = struct.unpack(">H", page[8:10])
                    if match := _CHAIN.search(page, cell, cell + 100):
                        chain.append((match[1], match[2]))
    except OSError:  # SQLite reports it
        return None
    if not has_commits:
        return None
    return {chain[0][0].decode(), *(own.decode() for _, own in chain)} if chain else {_NO_TOKEN}


def _token(path: Path, how: str) -> str | None:
    """The last token in a database; None if it cannot be read. `immutable`: in the file itself, without the WAL."""
    # through SQLite, because closing an own file handle would release SQLite's locks
    try:
        with closing(sqlite3.connect(f"file:{quote(str(path.resolve()))}?{how}", uri=True)) as connection:
            # A checkpoint that a reader or writer limits moves only the pages that have not changed since. The first
            # page can then give a larger size than the file has, which SQLite takes for damage without this setting.
            connection.execute("PRAGMA writable_schema = ON")
            if connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'generation'").fetchone() is None:
                return _NO_TOKEN
            row = connection.execute("SELECT chain FROM generation").fetchone()
    except sqlite3.Error:
        return None
    match = _CHAIN.fullmatch(str(row[0]).encode()) if row else None
    return match[2].decode() if match else None


SHARED_MEMORY, JOURNAL = "-shm", "-journal"

Identity = tuple[int, ...]


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
        self._is_fixed = not self.is_writable and not _has_wal(self.place)
        # An inode is not used again while a connection has it open. SQLite keeps the files beside it while one is
        # open; without them, processes would not see each other's changes, and lose them.
        self._identities = {self.place: self._identity(self.place)}
        # size and time of the file when it was last looked at, and the newest token known
        self._stamp: tuple[int, int] | None = None
        self._newest = ""
        self._is_overwritten = False

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
            what = "was replaced by another file, or written over," if path.exists() else "was removed"
            raise ReplacedError(
                f"{self.path.with_name(path.name)}: {what} while it was open, and nothing was saved in it since; "
                "reload the page, or start the command again, and repeat the latest change"
            )

    def remember(self) -> None:
        """Remembers the content, and SQLite's files beside the database; called when a connection has used it."""
        if not self.is_writable:
            return
        self._stamp = stamp_of(self.place)
        self.written(_token(self.place, "mode=ro") or "")
        for suffix in (WAL, SHARED_MEMORY):
            path = self.place.with_name(self.place.name + suffix)
            self._identities[path] = self._identity(path)

    def _is_written_over(self) -> bool:
        """True if another database, or an older copy, was written over the file, as `cp` does."""
        # only a checkpoint or a copy writes to the file itself, so this is rarely more than one `stat`
        if self._stamp is None or self._is_overwritten or (stamp := stamp_of(self.place)) == self._stamp:
            return self._is_overwritten
        known = self._newest  # before the file is read: other threads write, too
        seen = _token(self.place, "mode=ro") or known
        # two states with one number, but other digits, have parted before
        is_older = seen != known and seen[:_NUMBER] <= known[:_NUMBER]
        self._is_overwritten = is_older or has_foreign_wal(self.place)
        if not self._is_overwritten:
            self._stamp = stamp
            self.written(seen)
        return self._is_overwritten

    def written(self, token: str) -> None:
        """Remembers a token that the database has got."""
        self._newest = max(self._newest, token)

    def closing(self) -> None:
        """Empties the `-wal` of a database that was written over: SQLite would move it into the copy when it closes."""
        is_same = self._identity(self.place) == self._identities[self.place]
        if is_same and self._is_written_over() and has_foreign_wal(self.place):
            with suppress(OSError):
                os.truncate(wal_of(self.place), 0)
        self._stamp = None

    def _what_changed(self) -> Path | None:
        known = self._identities.items()
        changed = next((path for path, identity in known if self._identity(path) != identity), None)
        return self.place if changed is None and self._is_written_over() else changed

    def _identity(self, path: Path) -> Identity | None:
        """Device and inode of a file, None if it is missing; of a fixed one, also what any writing changes."""
        try:
            found = path.stat()
        except OSError:
            return None
        identity = (found.st_dev, found.st_ino)
        return (*identity, found.st_size, found.st_mtime_ns, _has_wal(path)) if self._is_fixed else identity

    def _require_regular(self) -> None:
        """Refuses pipes and devices in place of the database or of the files beside it: SQLite would wait."""
        for suffix in ("", WAL, SHARED_MEMORY, JOURNAL):
            path = self.place.with_name(self.place.name + suffix)
            with suppress(OSError):
                if not stat.S_ISREG(path.stat().st_mode):
                    raise ProjectError(f"{path}: is not a regular file; remove it")


def stamp_of(path: Path) -> tuple[int, int] | None:
    """Time and size of a file, which change when it is written; None if it is missing."""
    try:
        found = path.stat()
    except OSError:  # a missing file is noticed elsewhere
        return None
    return found.st_mtime_ns, found.st_size


def _has_wal(path: Path) -> bool:
    """True if there are changes beside the database, or another process has it open."""
    try:
        wal = wal_of(path).stat()
    except OSError:
        return False
    return wal.st_size > 0 or path.with_name(path.name + SHARED_MEMORY).exists()
