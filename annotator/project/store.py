"""The SQLite database of one project: connections, transactions, errors, and migrations when it is opened."""

from __future__ import annotations

import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.exc import DBAPIError
from sqlalchemy.pool import QueuePool

from annotator.files import make_private
from annotator.project.backup.generation import advance, has_foreign_wal, wal_of
from annotator.project.migrations import APPLICATION_ID, MIGRATIONS, Migration, upgrade
from annotator.types.errors import RESTORE, ProjectError

DATABASE_FILE = "project.db"
BUSY_TIMEOUT_S = 10.0
# The web server uses about this many threads at once, each with its own connection.
THREADS = 20

Clock = Callable[[], int]

_BEGIN = "annotator_begin"

_PROBLEMS = {
    sqlite3.SQLITE_BUSY: "is locked by another process; close programs that use this project, or wait, and try again",
    sqlite3.SQLITE_LOCKED: "is locked by another process; close programs that use this project, or wait, and try again",
    sqlite3.SQLITE_CORRUPT: f"is damaged; {RESTORE}; `annotator project repair` saves what is still readable",
    sqlite3.SQLITE_NOTADB: f"is not a project database, or its beginning is damaged; {RESTORE}",
    sqlite3.SQLITE_READONLY: "cannot be written; check the permissions of the file and of its folder",
    sqlite3.SQLITE_CANTOPEN: "cannot be opened; check the permissions of the file and of its folder",
    sqlite3.SQLITE_FULL: "cannot be written, because the disk is full; nothing was changed; free some space",
    sqlite3.SQLITE_IOERR: "cannot be read or written because of a disk error; nothing was changed; check the disk",
}


@dataclass(frozen=True, eq=False)
class Store:
    """One open database. Thread-safe, but not fork-safe: each process opens its own.

    Attributes:
        path: the database file.
        engine: SQLAlchemy's pool of connections.
        clock: returns the current time, UTC nanoseconds since the epoch.
        write_lock: held by the thread that writes.
    """

    path: Path
    engine: Engine
    clock: Clock = time.time_ns
    write_lock: threading.Lock = field(default_factory=threading.Lock)
    _begun: threading.Event = field(default_factory=threading.Event)

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """A transaction that sees one snapshot of the database, unaffected by concurrent writes.

        Raises:
            ProjectError: the database is locked, damaged or cannot be read.
        """
        with self._transaction("BEGIN") as connection:
            yield connection

    @contextmanager
    def write(self) -> Iterator[Connection]:
        """A write transaction, committed as a whole or not at all.

        It takes SQLite's write lock at its beginning: SQLite refuses to upgrade a read transaction whose snapshot is
        outdated. Threads wait for `write_lock` before they take a connection; otherwise they would poll inside SQLite
        and occupy connections that readers need.

        Raises:
            ProjectError: the database stays locked, is damaged, or cannot be written.
        """
        # after the timeout, SQLite itself reports the problem
        has_lock = self.write_lock.acquire(timeout=BUSY_TIMEOUT_S)
        try:
            if not self._begun.is_set():
                self._begin_writing()
            with self._transaction("BEGIN IMMEDIATE") as connection:
                advance(connection)
                yield connection
        finally:
            if has_lock:
                self.write_lock.release()

    def _begin_writing(self) -> None:
        """Changes the database file itself, so that it differs from every copy made before (`backup.generation`)."""
        with self._transaction("BEGIN IMMEDIATE") as connection:
            advance(connection)
        with explained(self.path), closing(self.engine.raw_connection()) as outside_transactions:
            _, logged, moved = outside_transactions.cursor().execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
        # a reader of an older state can prevent it; the next write then tries again
        if logged == moved:
            self._begun.set()

    @contextmanager
    def _transaction(self, begin: str) -> Iterator[Connection]:
        with explained(self.path), self.engine.connect() as connection:
            connection = connection.execution_options(**{_BEGIN: begin})
            with connection.begin():
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
        """Closes all connections."""
        self.engine.dispose()


def create_store(path: Path, *, clock: Clock = time.time_ns) -> Store:
    """Creates a database of the newest version at `path`, which only its owner may read.

    Raises:
        ProjectError: the file exists already, or cannot be written.
        OSError: the file cannot be created.
    """
    if path.exists():
        raise ProjectError(f"{path}: exists already")
    # SQLite gives the files beside it the same rights
    make_private(path)
    store = _store(path, "rwc", BUSY_TIMEOUT_S, clock)
    with _closed_on_error(store), explained(path):
        with closing(store.engine.raw_connection()) as outside_transactions:
            # stored in the file, so it applies to every later connection
            outside_transactions.cursor().execute("PRAGMA journal_mode = WAL")
        with store._transaction("BEGIN IMMEDIATE") as connection:
            connection.exec_driver_sql(f"PRAGMA application_id = {APPLICATION_ID}")
            upgrade(connection, path, MIGRATIONS)
    return store


def open_store(
    path: Path,
    *,
    busy_timeout_s: float = BUSY_TIMEOUT_S,
    clock: Clock = time.time_ns,
    migrations: tuple[Migration, ...] = MIGRATIONS,
    before_upgrade: Callable[[int], None] | None = None,
) -> Store:
    """Opens the database at `path` and upgrades an older one to the newest version.

    Args:
        before_upgrade: called with the version of a database that will be upgraded; may raise to prevent it.

    Raises:
        ProjectError: it is missing, not a project database, damaged, locked, or of a newer version; or the file
            `-wal` beside it belongs to another database.
    """
    if not path.is_file():
        raise ProjectError(f"{path}: is missing; {RESTORE}")
    if has_foreign_wal(path):
        raise ProjectError(foreign_wal(path))
    store = _store(path, "rw", busy_timeout_s, clock)
    with _closed_on_error(store):
        with store.read() as connection:
            application_id = connection.exec_driver_sql("PRAGMA application_id").scalar_one()
            version = connection.exec_driver_sql("PRAGMA user_version").scalar_one()
            # reading the schema detects a truncated or overwritten file at once
            connection.exec_driver_sql("SELECT count(*) FROM sqlite_master").scalar_one()
        if application_id != APPLICATION_ID:
            raise ProjectError(f"{path}: is an SQLite database, but not a project database; {RESTORE}")
        if version != migrations[-1].version:
            if before_upgrade is not None:
                before_upgrade(version)
            with store._transaction("BEGIN IMMEDIATE") as connection:
                upgrade(connection, path, migrations)
    return store


def foreign_wal(path: Path) -> str:
    """The problem that `has_foreign_wal` finds, in words."""
    return (
        f"{path}: does not belong to the file {wal_of(path).name} beside it; probably it is a copy that was put there "
        "by hand, and the other file is left from a newer state; nothing was changed. `annotator project repair` makes "
        "a new project of it without that file"
    )


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Converts SQLite's errors about the file `path` into a ProjectError that says what to do.

    Raises:
        ProjectError: the database is locked, damaged, not writable or out of space.
    """
    try:
        yield
    except (DBAPIError, sqlite3.Error) as error:
        cause = error.orig if isinstance(error, DBAPIError) else error
        code = getattr(cause, "sqlite_errorcode", None)
        # the low byte is the primary result code
        problem = None if code is None else _PROBLEMS.get(code & 0xFF)
        if problem is None:
            raise
        raise ProjectError(f"{path}: {problem} ({cause})") from error


@contextmanager
def _closed_on_error(store: Store) -> Iterator[None]:
    try:
        yield
    except BaseException:
        store.close()
        raise


def _store(path: Path, mode: str, busy_timeout_s: float, clock: Clock) -> Store:
    address = f"file:{quote(str(path.resolve()))}?mode={mode}"

    def connect() -> sqlite3.Connection:
        connection = sqlite3.connect(
            address,
            uri=True,
            timeout=busy_timeout_s,
            isolation_level=None,  # the begin event below starts transactions, not the sqlite3 module
            check_same_thread=False,  # the pool hands a connection to one thread at a time
        )
        connection.execute("PRAGMA foreign_keys = ON")
        # FULL waits for the disk at every commit, which takes milliseconds: a change is acknowledged only when it is
        # safe. NORMAL in WAL mode may lose the last commits in a power cut.
        connection.execute("PRAGMA synchronous = FULL")
        # without it, INSERT OR REPLACE removes rows without firing the append-only triggers
        connection.execute("PRAGMA recursive_triggers = ON")
        return connection

    engine = create_engine("sqlite://", creator=connect, poolclass=QueuePool, pool_size=THREADS, max_overflow=THREADS)

    @event.listens_for(engine, "begin")
    def begin(connection: Connection) -> None:
        connection.exec_driver_sql(connection.get_execution_options().get(_BEGIN, "BEGIN"))

    return Store(path, engine, clock)
