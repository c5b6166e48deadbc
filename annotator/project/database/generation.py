"""Whether a `-wal` file belongs to the database beside it.

SQLite keeps the latest transactions in `project.db-wal`. If a process is killed, this file stays, and SQLite applies it
to whatever `project.db` it finds when the database is opened next: also to an older copy that somebody has put there.
The result is a newer state than that of the copy, or a damaged database. SQLite's own headers do not prevent this.

So each write transaction stores a new token and the token of the transaction before it (table `generation`). The
first write of a process is a transaction that is moved into `project.db` at once, so the file then differs from every
earlier copy of it. A `-wal` belongs to a database if the token in `project.db` is one of those in the `-wal`, or the
one before its first. A token consists of a number, one more than that of the token before, and of random digits. So a
process that has the database open notices an older copy, too.
"""

from __future__ import annotations

import logging
import os
import re
import sqlite3
import struct
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from sqlalchemy import Connection

from annotator.files import open_file

NO_TOKEN = "0" * 32
# Attempts to read both files while another process writes.
_ATTEMPTS = 5
# Looks that must find a database written over, and the time between them.
_LOOKS, _LOOKS_AGAIN_AFTER_S = 4, 0.05
LOG = logging.getLogger("annotator.project")
_ADVANCE = (
    "UPDATE generation SET chain = 'annotator-generation ' || substr(chain, -32) || ' ' "
    "|| printf('%016d', CAST(substr(chain, -32, 16) AS INTEGER) + 1) || lower(hex(randomblob(8)))"
)
# of a token, as far as it is not damaged
_NUMBER = re.compile(r"[0-9]{0,16}")
_CHAIN = re.compile(rb"annotator-generation ([0-9a-f]{32}) ([0-9a-f]{32})")
# SQLite's file format, sections 4.1 and 4.2: sizes of the headers of a WAL and of its frames, the two magic numbers.
# Sizes of pages that SQLite knows.
_PAGE_BYTES = {2**power for power in range(9, 17)}
_HEADER, _FRAME_HEADER, _MAGIC = 32, 24, (0x377F0682, 0x377F0683)
_TABLE_LEAF = 0x0D


def advance(connection: Connection) -> str:
    """Stores a new token, within the caller's write transaction, and returns it."""
    connection.exec_driver_sql(_ADVANCE)
    token: str = connection.exec_driver_sql("SELECT substr(chain, -32) FROM generation").scalar_one()
    return token


def has_foreign_wal(path: Path) -> bool:
    """True if the `-wal` file beside the database `path` belongs to another database, or to another state of it.

    False for a database that cannot be read: SQLite reports what is wrong with it.
    """
    for look in range(_LOOKS):
        if not _looks_foreign(path):
            return False
        if look < _LOOKS - 1:
            time.sleep(_LOOKS_AGAIN_AFTER_S)
    return True


def _looks_foreign(path: Path, known: _Wal | None = None) -> bool:
    """The same at one look. It can be wrong while a process writes, as the files are not read at one moment.

    Args:
        known: what was read of the `-wal` before.
    """
    wal = wal_of(path)
    for _ in range(_ATTEMPTS):
        before, token = _read_wal(wal, known), _stored(path)
        after = _read_wal(wal, before)
        if before is None or after is None or token is None:
            return False
        # else another process has begun the file anew in the meantime
        if before.salts == after.salts and token == _stored(path):
            return not after.follows(token)
    return False  # in use, and thus not left over


class Lineage:
    """Notices that another database, or an older copy, was written over an open one, whose file stays the same.

    Call `begin` first; before, nothing is noticed.
    """

    def __init__(self) -> None:
        self._path: Path | None = None
        # time and size of the file when it was last looked at, and the token in it
        self._stamp: tuple[int, int] | None = None
        self._stored = NO_TOKEN
        # the newest token known: of this process, or seen at the last look
        self._newest = NO_TOKEN
        # what was read of the `-wal`, which has thousands of pages: only what is new is read
        self._wal: _Wal | None = None
        self._is_broken = False

    def begin(self, path: Path) -> None:
        """Takes the present content of the database `path` for the right one."""
        self._path, self._stamp, self._stored = path, _stamp(path), _stored(path) or NO_TOKEN

    def is_broken(self, looks: int = _LOOKS) -> bool:
        """True if what the file contains does not come from what it contained before.

        Args:
            looks: number of looks that must agree.
        """
        # only a checkpoint or a copy writes to the file itself, so this is rarely more than one `stat`
        stamp = None if self._is_broken or self._path is None else _stamp(self._path)
        if stamp is not None and stamp != self._stamp:
            assert self._path is not None
            # known before the file is read: other threads look and write, too
            known, newest = self._stored, self._newest
            stored, seen = _stored(self._path), _seen(self._path)
            self._wal = wal = _read_wal(wal_of(self._path), self._wal)
            if seen is None or stored is None:  # locked, or damaged: SQLite reports it
                return False
            if not (_is_older(stored, known) or _is_older(seen, newest) or _looks_foreign(self._path, wal)):
                self._stamp, self._stored = stamp, stored
                self.written(seen)
            elif looks > 1:
                # the files are not read at one moment, and a verdict empties the `-wal`: another look must agree
                time.sleep(_LOOKS_AGAIN_AFTER_S)
                return self.is_broken(looks - 1)
            else:
                LOG.error(
                    "%s: another database was written over it: it has %s and %s; known were %s and %s",
                    self._path,
                    stored,
                    seen,
                    known,
                    newest,
                )
                self._is_broken = True
        return self._is_broken

    def written(self, token: str) -> None:
        """Remembers a token that the database has got."""
        if not _is_older(token, self._newest):
            self._newest = token

    def has_left_wal(self) -> bool:
        """True if the `-wal` beside the database is that of the former content, and not of what replaced it."""
        if self._path is None or (wal := _read_wal(wal_of(self._path))) is None:
            return False
        return has_foreign_wal(self._path) or any(self._stored in link for link in wal.chain)


def _stamp(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except OSError:  # the file itself is missing, which is noticed elsewhere
        return None
    return found.st_mtime_ns, found.st_size


def _is_older(token: str, known: str) -> bool:
    """Whether a database with a token is not the one with a known token, or a later state of it."""
    return token != known and _number(token) <= _number(known)


def _number(token: str) -> int:
    match = _NUMBER.match(token, 0, 16)
    return int(match[0] or 0) if match else 0


def wal_of(path: Path) -> Path:
    """The `-wal` file of a database."""
    return path.with_name(f"{path.name}-wal")


@dataclass(frozen=True)
class _Wal:
    """What matters of a WAL.

    Attributes:
        salts: random numbers that identify its content.
        chain: for each transaction, the token of the one before, and its own.
        has_commits: True if it contains a complete transaction.
        ends_at: where its last complete transaction ends, bytes. What follows may be written over.
        number: of the links up to there.
    """

    salts: bytes
    chain: tuple[tuple[str, str], ...]
    has_commits: bool
    ends_at: int
    number: int

    def follows(self, token: str) -> bool:
        """Whether it can be applied to a database whose last transaction had that token."""
        if not self.has_commits:
            return True
        if not self.chain:
            return token == NO_TOKEN
        return token in {self.chain[0][0], *(own for _, own in self.chain)}


def _read_wal(path: Path, known: _Wal | None = None) -> _Wal | None:
    """Reads a WAL; None if there is none, or if SQLite would ignore it.

    Args:
        known: what was read of it before; the same is not read again.
    """
    try:
        with open_file(path) as file:
            header = file.read(_HEADER)
            if len(header) < _HEADER or int.from_bytes(header[:4], "big") not in _MAGIC:
                return None
            (page_bytes,), salts = struct.unpack(">I", header[8:12]), header[16:24]
            if page_bytes not in _PAGE_BYTES:
                return None
            if known is not None and known.salts == salts and os.fstat(file.fileno()).st_size >= known.ends_at:
                file.seek(known.ends_at)
            else:
                known = _Wal(salts, (), False, _HEADER, 0)
            has_commits, ends_at, number = known.has_commits, known.ends_at, known.number
            chain = list(known.chain[:number])
            at = ends_at
            while len(frame := file.read(_FRAME_HEADER + page_bytes)) == _FRAME_HEADER + page_bytes:
                # left from before the file was begun anew, or no page at all
                if frame[8:16] != salts or not any(frame[:4]):
                    break
                at += len(frame)
                chain += _links(frame[_FRAME_HEADER:])
                if any(frame[4:8]):
                    has_commits, ends_at, number = True, at, len(chain)
    except FileNotFoundError:
        return None
    except OSError:  # SQLite reports it
        return None
    return _Wal(salts, tuple(chain), has_commits, ends_at, number)


def _links(page: bytes) -> Iterator[tuple[str, str]]:
    """The tokens of the table's page; nothing for other pages."""
    if page[0] == _TABLE_LEAF and page[3:5] == b"\0\1":  # one row
        (cell,) = struct.unpack(">H", page[8:10])
        if match := _CHAIN.search(page, cell, cell + 100):
            yield match[1].decode(), match[2].decode()


def _stored(path: Path) -> str | None:
    """The last token in the database file itself, without the WAL; NO_TOKEN if it has none, None if unreadable."""
    return _token(path, "immutable=1")


def _seen(path: Path) -> str | None:
    """The last token that a new connection sees, so without cached pages; NO_TOKEN or None as for `_stored`."""
    return _token(path, "mode=ro")


def _token(path: Path, how: str) -> str | None:
    # through SQLite, because closing an own file handle would release SQLite's locks
    try:
        with closing(sqlite3.connect(f"file:{quote(str(path.resolve()))}?{how}", uri=True)) as connection:
            # A checkpoint that a reader or writer limits moves only the pages that have not changed since. The first
            # page can then give a larger size than the file has, which SQLite takes for damage without this setting.
            connection.execute("PRAGMA writable_schema = ON")
            if connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'generation'").fetchone() is None:
                return NO_TOKEN
            row = connection.execute("SELECT chain FROM generation").fetchone()
    except sqlite3.Error:
        return None
    match = _CHAIN.fullmatch(str(row[0]).encode()) if row else None
    return match[2].decode() if match else None
