"""The SQLite database of one project: its file, connections, transactions, errors, and migrations when it is opened.

Nothing here opens the database but SQLite: closing any other descriptor of it would drop SQLite's locks, which belong
to the process.
"""

from __future__ import annotations

import os
import sqlite3
import stat
import threading
import time
from collections.abc import Callable, Iterator, MutableMapping
from contextlib import closing, contextmanager, suppress
from contextvars import ContextVar
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.exc import DBAPIError
from sqlalchemy.exc import TimeoutError as NoConnectionError
from sqlalchemy.pool import QueuePool
from sqlalchemy.util import LRUCache

from annotator.project.database.migrations import (
    APPLICATION_ID,
    newest_version,
    schema_problems,
    upgrade,
    version_problem,
)
from annotator.types.errors import RESTORE, ProjectError, ReplacedError

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
        self._is_fixed = not self.is_writable and not _has_wal(self.place)
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
        """Checks that the file is still the one on disk."""
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
        return (*identity, found.st_size, found.st_mtime_ns, _has_wal(path)) if self._is_fixed else identity

    def _require_regular(self) -> None:
        """Refuses pipes and devices in place of the database or of the files beside it: SQLite would wait."""
        for suffix in ("", WAL, SHARED_MEMORY, JOURNAL):
            path = self.place.with_name(self.place.name + suffix)
            with suppress(OSError):
                if not stat.S_ISREG(path.stat().st_mode):
                    raise ProjectError(f"{path}: is not a regular file; remove it")


def _has_wal(path: Path) -> bool:
    """True if there are changes beside the database, or another process has it open."""
    try:
        wal = wal_of(path).stat()
    except OSError:
        return False
    return wal.st_size > 0 or path.with_name(path.name + SHARED_MEMORY).exists()


_AT_MOST_S: ContextVar[float] = ContextVar("annotator_waits_at_most_s", default=float("inf"))


@contextmanager
def waiting_at_most(seconds: float) -> Iterator[None]:
    """Within the block, this thread waits no longer than this for any locked database.

    For code that serves several projects in turn, so that a locked one does not hold up the others.
    """
    token = _AT_MOST_S.set(seconds)
    try:
        yield
    finally:
        _AT_MOST_S.reset(token)


def patience_s(usual_s: float) -> float:
    """How long this thread waits, seconds; `usual_s` outside `waiting_at_most`."""
    return min(usual_s, _AT_MOST_S.get())


DATABASE_FILE = "project.db"
BUSY_TIMEOUT_S = 10.0
# The web server uses about this many threads at once, each with its own connection.
THREADS = 20

Clock = Callable[[], int]

_BEGIN = "annotator_begin"

# SQLite's messages about statements that do not fit the tables; all have the general code SQLITE_ERROR.
_MISFITS = ("no such table", "no such column", "has no column", "already exists", "duplicate column")

LOCKED = "is locked by another process; close programs that use this project, or wait, and try again"
_PROBLEMS: dict[int | None, str] = {
    sqlite3.SQLITE_BUSY: LOCKED,
    sqlite3.SQLITE_LOCKED: LOCKED,
    sqlite3.SQLITE_CORRUPT: f"is damaged; {RESTORE}; `annotator project repair` saves what is still readable",
    sqlite3.SQLITE_NOTADB: f"is not a project database, or its beginning is damaged; {RESTORE}",
    sqlite3.SQLITE_READONLY: "cannot be written; check the permissions of the file and of its folder",
    sqlite3.SQLITE_PERM: "cannot be opened; check the permissions of the file and of its folder",
    sqlite3.SQLITE_CANTOPEN: "cannot be opened; check the permissions of the file and of its folder",
    sqlite3.SQLITE_FULL: "cannot be written, because the disk is full; nothing was changed; free some space",
    sqlite3.SQLITE_IOERR: "cannot be read or written because of a disk error; nothing was changed; check the disk",
}


class Store:
    """One open database. Thread-safe, but not fork-safe: each process opens its own.

    Attributes:
        file: the database file, as it was when it was opened.
        engine: SQLAlchemy's pool of connections.
        clock: returns the current time, UTC nanoseconds since the epoch.
        write_lock: held by the thread that writes.
    """

    def __init__(self, path: Path, clock: Clock) -> None:
        self.path, self.file, self.clock = path, DatabaseFile(path), clock
        shared = _shared_engine()
        pool = QueuePool(self._connect, THREADS, THREADS, BUSY_TIMEOUT_S, dialect=shared.dialect)
        self.engine = Engine(pool, shared.dialect, shared.url, execution_options={"compiled_cache": _COMPILED})
        event.listen(self.engine, "begin", _begin)
        self.write_lock = threading.Lock()
        # `connection`: of the thread's `snapshot`
        self._thread = threading.local()

    def _connect(self) -> Any:  # typed as sqlite3.Connection, it is none of SQLAlchemy's
        self.file.require_current()
        connection = sqlite3.connect(
            self.file.address,
            uri=True,
            timeout=patience_s(BUSY_TIMEOUT_S),
            isolation_level=None,  # `_begin` starts transactions, not the sqlite3 module
            check_same_thread=False,  # the pool hands a connection to one thread at a time
        )
        try:
            # the file may have been replaced before SQLite opened it
            self.file.require_current()
            connection.execute("PRAGMA foreign_keys = ON")
            # views and triggers of a stranger's database may call no function with side effects
            connection.execute("PRAGMA trusted_schema = OFF")
            # FULL waits for the disk at every commit, which takes milliseconds: a change is acknowledged only when it
            # is safe. NORMAL in WAL mode may lose the last commits in a power cut.
            connection.execute("PRAGMA synchronous = FULL")
            # without it, INSERT OR REPLACE removes rows without firing the append-only triggers
            connection.execute("PRAGMA recursive_triggers = ON")
        except BaseException:
            connection.close()
            raise
        return connection

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """A transaction that sees one snapshot of the database, unaffected by concurrent writes.

        Raises:
            ReplacedError: the file was removed or replaced.
            ProjectError: the database is locked, damaged or cannot be read.
        """
        if (shared := getattr(self._thread, "connection", None)) is not None:
            yield shared
            return
        with self._transaction("BEGIN", patience_s(BUSY_TIMEOUT_S)) as connection:
            yield connection

    @contextmanager
    def snapshot(self) -> Iterator[None]:
        """Within the block, all of the thread's reads see one snapshot, in one transaction: what is written meanwhile
        is not seen. For a page of several parts, which belong together.
        """
        with self.read() as connection:
            outer = getattr(self._thread, "connection", None)
            self._thread.connection = connection
            try:
                yield
            finally:
                self._thread.connection = outer

    @contextmanager
    def write(self) -> Iterator[Connection]:
        """A write transaction, committed as a whole or not at all.

        It takes SQLite's write lock at its beginning: SQLite refuses to upgrade a read transaction whose snapshot is
        outdated. Threads wait for `write_lock` before they take a connection; otherwise they would poll inside SQLite
        and occupy connections that readers need.

        Raises:
            ReplacedError: the file was removed or replaced, so that the change would be lost.
            ProjectError: the database stays locked, is damaged, or cannot be written.
        """
        if (outer := getattr(self._thread, "writing", None)) is not None:
            yield outer
            return
        self._require_writable()
        ends_s = time.monotonic() + patience_s(BUSY_TIMEOUT_S)
        # after the timeout, SQLite itself reports the problem
        has_lock = self.write_lock.acquire(timeout=max(0.0, ends_s - time.monotonic()))
        try:
            with self._transaction("BEGIN IMMEDIATE", max(0.0, ends_s - time.monotonic())) as connection:
                yield connection
            # the file may have been replaced since; only now it is sure that the change is in it
            self.file.require_current()
        finally:
            if has_lock:
                self.write_lock.release()

    @contextmanager
    def together(self) -> Iterator[None]:
        """Within the block, all that the thread writes is one transaction, as in `write`, and its reads see it."""
        with self.write() as connection:
            self._thread.writing = self._thread.connection = connection
            try:
                yield
            finally:
                self._thread.writing = self._thread.connection = None

    def _require_writable(self, why: str = "") -> None:
        if not self.file.is_writable:
            raise ProjectError(
                f"{self.path}: {why}is on a read-only disk, or you have no right to write it, so nothing was saved; to "
                "change this project, copy its folder to a place where you may write"
            )

    def upgrade(self) -> None:
        """Runs the missing migrations; errors as in `write`."""
        self._require_writable("is upgraded before it is used, but ")
        with self._transaction("BEGIN IMMEDIATE", BUSY_TIMEOUT_S) as connection:
            upgrade(driver_of(connection))

    @contextmanager
    def _transaction(self, begin: str, wait_s: float) -> Iterator[Connection]:
        with explained(self.path, self.file), self.engine.connect() as connection:
            connection = connection.execution_options(**{_BEGIN: (begin, round(wait_s * 1000))})
            with connection.begin():
                # after it has begun: it may have waited long for the lock
                self.file.require_current()
                yield connection

    def close(self) -> None:
        """Closes all connections."""
        self.engine.dispose()


def driver_of(connection: Connection) -> sqlite3.Connection:
    """SQLite's own connection, which is several times as fast for small statements."""
    driver = connection.connection.driver_connection
    assert isinstance(driver, sqlite3.Connection)
    return driver


def create_store(path: Path, *, clock: Clock = time.time_ns) -> Store:
    """Creates a database of the newest version at `path`, which only its owner may read."""
    try:
        # SQLite gives the files beside it the same rights
        path.touch(mode=0o600, exist_ok=False)
    except FileExistsError as error:
        raise ProjectError(f"{path}: exists already") from error
    store = Store(path, clock)
    with _closed_on_error(store), explained(path, store.file):
        with closing(store.engine.raw_connection()) as outside_transactions:
            # stored in the file, so they apply to every later connection
            outside_transactions.cursor().execute(f"PRAGMA application_id = {APPLICATION_ID}")
            outside_transactions.cursor().execute("PRAGMA journal_mode = WAL")
        store.upgrade()
    return store


def open_store(path: Path, *, clock: Clock = time.time_ns, before_upgrade: Callable[[], None] | None = None) -> Store:
    """Opens the database at `path` and upgrades an older one to the newest version.

    Args:
        before_upgrade: called before an older database is upgraded; may raise to prevent it.

    Raises:
        ReplacedError: it is missing.
        ProjectError: it is not a project database, damaged, locked, of a newer version, or has other tables, triggers
            or views than its version.
    """
    _require_file(path)
    store = Store(path, clock)
    with _closed_on_error(store):
        with store.read() as connection:
            driver = driver_of(connection)
            if (problem := version_problem(driver)) is None and (found := next(schema_problems(driver), None)):
                problem = (
                    f"{found}, so it was not opened. `annotator project repair` makes a new project of what can be "
                    f"read of it; or {RESTORE}"
                )
            (version,) = driver.execute("PRAGMA user_version").fetchone()
        if problem is not None:
            raise ProjectError(f"{path}: {problem}")
        if version < newest_version():
            if before_upgrade is not None and store.file.is_writable:
                before_upgrade()
            store.upgrade()
        store.file.remember()
    return store


def _require_file(path: Path) -> None:
    try:
        is_file = path.is_file()
    except OSError as error:
        raise ProjectError(f"{path}: cannot be read: {error.strerror}; check the permissions of its folder") from error
    if not is_file:
        raise ReplacedError(f"{path}: is missing; {RESTORE}")


@contextmanager
def explained(path: Path, file: DatabaseFile | None = None) -> Iterator[None]:
    """Converts SQLite's errors about the database `path` into a ProjectError that says what to do.

    Args:
        file: of an open store; it may have been replaced.

    Raises:
        ReplacedError: the file was removed or replaced, which explains the error.
        ProjectError: the database is locked, damaged, not writable or out of space.
    """
    try:
        yield
    except NoConnectionError as error:
        raise ProjectError(f"{path}: is in use by too many requests at once; try again") from error
    except (DBAPIError, sqlite3.Error) as error:
        if file is not None:
            file.require_current()
        cause = error.orig if isinstance(error, DBAPIError) else error
        problem = _problem(cause)
        if problem is None:
            raise
        raise ProjectError(f"{path}: {problem} ({cause})") from error


def is_lock(error: sqlite3.Error) -> bool:
    """Whether SQLite has waited in vain for another process."""
    return _primary(error) in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED)


def _problem(cause: BaseException | None) -> str | None:
    """What is wrong, and what to do; None for an error that a database cannot cause."""
    if getattr(cause, "sqlite_errorcode", None) == sqlite3.SQLITE_ERROR:
        if any(text in str(cause) for text in _MISFITS):
            return f"is damaged: its tables are not those of its version; {RESTORE}"
        if "malformed JSON" in str(cause):
            return f"is damaged: one of its rows cannot be read; {RESTORE}"
    return _PROBLEMS.get(_primary(cause))


def _primary(error: BaseException | None) -> int | None:
    """SQLite's primary result code: the low byte."""
    code = getattr(error, "sqlite_errorcode", None)
    return None if code is None else code & 0xFF


@contextmanager
def _closed_on_error(store: Store) -> Iterator[None]:
    try:
        yield
    except BaseException:
        store.close()
        raise


_COMPILED: MutableMapping[Any, Any] = LRUCache(1000)


@lru_cache(maxsize=1)
def _shared_engine() -> Engine:
    """An engine whose dialect all stores share, and with it their compiled queries, which take long to compile."""
    engine = create_engine("sqlite://")
    engine.connect().close()  # the dialect asks SQLite for its version
    engine.dispose()
    return engine


def _begin(connection: Connection) -> None:
    statement, wait_ms = connection.get_execution_options()[_BEGIN]
    connection.exec_driver_sql(f"PRAGMA busy_timeout = {wait_ms}")
    connection.exec_driver_sql(statement)
