"""The SQLite database of one project: connections, transactions, errors, and migrations when it is opened."""

from __future__ import annotations

import logging
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, MutableMapping
from contextlib import closing, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.exc import DBAPIError
from sqlalchemy.exc import TimeoutError as NoConnectionError
from sqlalchemy.pool import QueuePool
from sqlalchemy.util import LRUCache

from annotator.project.database.file import DatabaseFile, database_file, keep_replaced, kept_copies
from annotator.project.database.generation import advance, has_foreign_wal, wal_of
from annotator.project.database.migrations import (
    APPLICATION_ID,
    application_problem,
    newest_version,
    require_known,
    schema_problems,
    upgrade,
)
from annotator.types.errors import RESTORE, ProjectError, ReplacedError

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
# How long closing waits for a connection that another thread uses: one that reads is soon done.
KEEP_WAIT_S = 5.0
# The web server uses about this many threads at once, each with its own connection.
THREADS = 20

Clock = Callable[[], int]

LOG = logging.getLogger("annotator.project")

_READ_ONLY = "is on a read-only disk, or you have no right to write it"
_COPY_IT = "copy its folder to a place where you may write"
_BEGIN, _WAITS_MS = "annotator_begin", "annotator_waits_ms"

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


@dataclass(frozen=True, eq=False)
class Store:
    """One open database. Thread-safe, but not fork-safe: each process opens its own.

    Attributes:
        file: the database file, as it was when it was opened.
        engine: SQLAlchemy's pool of connections.
        busy_timeout_s: how long to wait while another process has locked it, seconds.
        clock: returns the current time, UTC nanoseconds since the epoch.
        write_lock: held by the thread that writes.
    """

    file: DatabaseFile
    engine: Engine
    busy_timeout_s: float = BUSY_TIMEOUT_S
    clock: Clock = time.time_ns
    write_lock: threading.Lock = field(default_factory=threading.Lock)
    _begun: threading.Event = field(default_factory=threading.Event)
    # `connection`: of the thread's `snapshot`
    _thread: threading.local = field(default_factory=threading.local)

    @property
    def path(self) -> Path:
        """The database file."""
        return self.file.path

    @property
    def pool(self) -> QueuePool:
        """The open connections."""
        pool = self.engine.pool
        assert isinstance(pool, QueuePool)
        return pool

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
        with self._transaction("BEGIN", patience_s(self.busy_timeout_s)) as connection:
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
        self._require_writable()
        ends_s = time.monotonic() + patience_s(self.busy_timeout_s)
        # after the timeout, SQLite itself reports the problem
        has_lock = self.write_lock.acquire(timeout=max(0.0, ends_s - time.monotonic()))
        try:
            if not self._begun.is_set():
                self._begin_writing(ends_s)
            with self._transaction("BEGIN IMMEDIATE", max(0.0, ends_s - time.monotonic())) as connection:
                token = advance(connection)
                yield connection
            self.file.lineage.written(token)
            # the file may have been replaced since; only now it is sure that the change is in it
            self.file.require_current()
        finally:
            if has_lock:
                self.write_lock.release()

    def _require_writable(self) -> None:
        if not self.file.is_writable:
            raise ProjectError(f"{self.path}: {_READ_ONLY}, so nothing was saved; to change this project, {_COPY_IT}")

    def upgrade(self, *, is_new: bool = False) -> None:
        """Runs the missing migrations; errors as in `write`."""
        if not self.file.is_writable:
            raise ProjectError(
                f"{self.path}: was written by an older annotator and must be upgraded before it is used, but it "
                f"{_READ_ONLY}; {_COPY_IT}"
            )
        with self._transaction("BEGIN IMMEDIATE", self.busy_timeout_s) as connection:
            if is_new:
                connection.exec_driver_sql(f"PRAGMA application_id = {APPLICATION_ID}")
            upgrade(connection)
            if not is_new:  # version 1 has stored the first token
                advance(connection)

    def _begin_writing(self, ends_s: float) -> None:
        """Changes the database file itself, so that it differs from every copy made before (`generation.py`)."""
        with self._transaction("BEGIN IMMEDIATE", max(0.0, ends_s - time.monotonic())) as connection:
            advance(connection)
        with explained(self.path, self.file), closing(self.engine.raw_connection()) as outside_transactions:
            _, logged, moved = outside_transactions.cursor().execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
        # a reader of an older state can prevent it; the next write then tries again
        if logged == moved:
            self._begun.set()

    @contextmanager
    def _transaction(self, begin: str, wait_s: float) -> Iterator[Connection]:
        with explained(self.path, self.file), self.engine.connect() as connection:
            _wait_at_most(connection, wait_s)
            connection = connection.execution_options(**{_BEGIN: begin})
            with connection.begin():
                # after it has begun: it may have waited long for the lock
                self.file.require_current()
                yield connection

    def problems(self) -> list[str]:
        """Problems that SQLite finds in the whole file; empty for a sound database.

        Raises:
            ProjectError: the file cannot be read at all.
        """
        with self.read() as connection:
            lines = [str(row[0]) for row in connection.exec_driver_sql("PRAGMA integrity_check")]
            orphans = connection.exec_driver_sql("PRAGMA foreign_key_check").all()
        return [line for line in lines if line != "ok"] + [
            f"row that refers to a missing row: {tuple(row)}" for row in orphans
        ]

    def close(self) -> None:
        """Closes all connections; what a replaced database held is kept first."""
        # without a connection it is closed already; and who removes or replaces a whole project means it
        if self._has_connection() and self.file.is_same_folder() and not self.file.is_current():
            self._keep()
        self.engine.dispose()

    def _has_connection(self) -> bool:
        """Whether a connection is free, after waiting a little for those that others use."""
        ends_s = time.monotonic() + KEEP_WAIT_S
        while not self.pool.checkedin() and self.pool.checkedout() and time.monotonic() < ends_s:
            time.sleep(0.01)
        return self.pool.checkedin() > 0

    def _keep(self) -> None:
        try:
            # a connection of the pool, since a new one would open the other file
            with closing(self.engine.raw_connection()) as connection:
                assert isinstance(connection.driver_connection, sqlite3.Connection)
                keep_replaced(connection.driver_connection, self.file)
        except (ProjectError, DBAPIError, NoConnectionError) as error:
            LOG.error("%s: was replaced, and what it held could not be kept: %s", self.path, error)


def create_store(path: Path, *, clock: Clock = time.time_ns) -> Store:
    """Creates a database of the newest version at `path`, which only its owner may read.

    Raises:
        ProjectError: the file exists already, or cannot be written.
        OSError: the file cannot be created.
    """
    try:
        # SQLite gives the files beside it the same rights
        path.touch(mode=0o600, exist_ok=False)
    except FileExistsError as error:
        raise ProjectError(f"{path}: exists already") from error
    store = _store(database_file(path), BUSY_TIMEOUT_S, clock)
    with _closed_on_error(store), explained(path, store.file):
        with closing(store.engine.raw_connection()) as outside_transactions:
            # stored in the file, so it applies to every later connection
            outside_transactions.cursor().execute("PRAGMA journal_mode = WAL")
        store.upgrade(is_new=True)
    return store


def open_store(
    path: Path,
    *,
    busy_timeout_s: float = BUSY_TIMEOUT_S,
    clock: Clock = time.time_ns,
    before_upgrade: Callable[[], None] | None = None,
) -> Store:
    """Opens the database at `path` and upgrades an older one to the newest version.

    Args:
        before_upgrade: called before an older database is upgraded; may raise to prevent it.

    Raises:
        ReplacedError: it is missing.
        ProjectError: it is not a project database, damaged, locked, of a newer version, or has other tables, triggers
            or views than its version; or the file `-wal` beside it belongs to another database.
    """
    _require_file(path)
    if has_foreign_wal(path):
        raise ProjectError(foreign_wal(path))
    store = _store(database_file(path), busy_timeout_s, clock)
    with _closed_on_error(store):
        with store.read() as connection:
            application_id = connection.exec_driver_sql("PRAGMA application_id").scalar_one()
            version = connection.exec_driver_sql("PRAGMA user_version").scalar_one()
            # reading the schema detects a truncated or overwritten file at once
            connection.exec_driver_sql("SELECT count(*) FROM sqlite_master").scalar_one()
        if problem := application_problem(application_id):
            raise ProjectError(f"{path}: {problem}")
        require_known(version, path)
        with explained(path), closing(store.engine.raw_connection()) as raw:
            assert isinstance(raw.driver_connection, sqlite3.Connection)
            if found := next(schema_problems(raw.driver_connection, version, serious=True), None):
                raise ProjectError(
                    f"{path}: {found}, so it was not opened. `annotator project repair` makes a new project of what "
                    f"can be read of it; or {RESTORE}"
                )
        if version < newest_version():
            if before_upgrade is not None and store.file.is_writable:
                before_upgrade()
            store.upgrade()
        store.file.remember()
    return store


def foreign_wal(path: Path) -> str:
    """The problem that `has_foreign_wal` finds, in words."""
    return (
        f"{path}: does not belong to the file {wal_of(path).name} beside it; probably it is a copy that was put there "
        "by hand, and the other file is left from a newer state; nothing was changed. `annotator project repair` makes "
        "a new project of it without that file"
    )


def _require_file(path: Path) -> None:
    try:
        is_file = path.is_file()
    except OSError as error:
        raise ProjectError(f"{path}: cannot be read: {error.strerror}; check the permissions of its folder") from error
    if not is_file:
        kept = kept_copies(path.parent.absolute())
        remedy = f"move {kept[-1]}, which was kept of it, to {path}, or " if kept else ""
        raise ReplacedError(f"{path}: is missing; {remedy}{RESTORE}")


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


def _wait_at_most(connection: Connection, seconds: float) -> None:
    """Sets how long the connection waits for locks, if it differs from before."""
    milliseconds = round(seconds * 1000)
    if connection.info.get(_WAITS_MS) != milliseconds:
        driver = connection.connection.driver_connection
        assert isinstance(driver, sqlite3.Connection)
        driver.execute(f"PRAGMA busy_timeout = {milliseconds}")
        connection.info[_WAITS_MS] = milliseconds


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


def _store(file: DatabaseFile, busy_timeout_s: float, clock: Clock) -> Store:
    def connect() -> Any:  # typed as sqlite3.Connection, it is none of SQLAlchemy's
        file.require_current()
        connection = sqlite3.connect(
            file.address,
            uri=True,
            timeout=patience_s(busy_timeout_s),
            isolation_level=None,  # the begin event below starts transactions, not the sqlite3 module
            check_same_thread=False,  # the pool hands a connection to one thread at a time
        )
        try:
            # the file may have been replaced before SQLite opened it
            file.require_current()
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

    shared = _shared_engine()
    pool = QueuePool(connect, THREADS, THREADS, busy_timeout_s, dialect=shared.dialect)
    engine = Engine(pool, shared.dialect, shared.url, execution_options={"compiled_cache": _COMPILED})

    @event.listens_for(engine, "begin")
    def begin(connection: Connection) -> None:
        connection.exec_driver_sql(connection.get_execution_options().get(_BEGIN, "BEGIN"))

    return Store(file, engine, busy_timeout_s, clock)
