"""The SQLite database of one project: connections, transactions, migrations at opening."""

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
from sqlalchemy.pool import QueuePool

from annotator.project.faults import told_plainly
from annotator.project.migrations import APPLICATION_ID, MIGRATIONS, Migration, upgrade
from annotator.types.errors import ProjectError

DATABASE_FILE = "project.db"
BUSY_TIMEOUT_S = 10.0
# A web server answers in about so many threads at once, each with a connection of its own.
THREADS = 20

Clock = Callable[[], int]

_BEGIN = "annotator_begin"


@dataclass(frozen=True, eq=False)
class Store:
    """One open database; many threads may share it, each process opens its own.

    Attributes:
        path: the database file.
        engine: SQLAlchemy's pool of connections.
        clock: gives the present, UTC nanoseconds since the epoch.
        turn: held by the thread that writes.
    """

    path: Path
    engine: Engine
    clock: Clock = time.time_ns
    turn: threading.Lock = field(default_factory=threading.Lock)

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """A transaction that sees one moment of the database, whatever others write meanwhile.

        Raises:
            ProjectError: the database is locked, damaged or cannot be read.
        """
        with self._transaction("BEGIN") as connection:
            yield connection

    @contextmanager
    def write(self) -> Iterator[Connection]:
        """A transaction that holds the write lock from its beginning; all of it is kept, or nothing.

        The lock is taken at once: a reader that turns writer later would have to be refused as stale. Threads wait for
        each other here, without a connection: SQLite would let them sleep and try again, and readers would find none.

        Raises:
            ProjectError: the database stays locked, is damaged, or cannot be written.
        """
        # after so long SQLite itself says what is wrong
        has_turn = self.turn.acquire(timeout=BUSY_TIMEOUT_S)
        try:
            with self._transaction("BEGIN IMMEDIATE") as connection:
                yield connection
        finally:
            if has_turn:
                self.turn.release()

    @contextmanager
    def _transaction(self, begin: str) -> Iterator[Connection]:
        with told_plainly(self.path), self.engine.connect() as connection:
            connection = connection.execution_options(**{_BEGIN: begin})
            with connection.begin():
                yield connection

    def problems(self) -> list[str]:
        """What SQLite finds wrong when it reads the whole file; empty for a sound database.

        Raises:
            ProjectError: the file cannot be read at all.
        """
        with self.read() as connection:
            found = [str(row[0]) for row in connection.exec_driver_sql("PRAGMA integrity_check")]
            orphans = connection.exec_driver_sql("PRAGMA foreign_key_check").all()
        return [line for line in found if line != "ok"] + [f"row without its parent: {tuple(row)}" for row in orphans]

    def close(self) -> None:
        """Give all connections back."""
        self.engine.dispose()


def create_store(path: Path, *, clock: Clock = time.time_ns) -> Store:
    """A new database at `path`, of the newest version.

    Raises:
        ProjectError: the file exists already, or cannot be written.
    """
    if path.exists():
        raise ProjectError(f"{path}: exists already")
    store = _store(path, "rwc", BUSY_TIMEOUT_S, clock)
    with _closed_on_error(store), told_plainly(path):
        with closing(store.engine.raw_connection()) as outside_transactions:
            # kept in the file: every later connection finds it in WAL mode
            outside_transactions.cursor().execute("PRAGMA journal_mode = WAL")
        with store.write() as connection:
            connection.exec_driver_sql(f"PRAGMA application_id = {APPLICATION_ID}")
            upgrade(connection, path, MIGRATIONS)
    return store


def open_store(
    path: Path,
    *,
    busy_timeout_s: float = BUSY_TIMEOUT_S,
    clock: Clock = time.time_ns,
    migrations: tuple[Migration, ...] = MIGRATIONS,
) -> Store:
    """The database at `path`, brought to the newest version.

    Raises:
        ProjectError: it is missing, not a project's, damaged, locked, or of a newer version.
    """
    if not path.is_file():
        raise ProjectError(f"{path}: is missing; restore it from a backup")
    store = _store(path, "rw", busy_timeout_s, clock)
    with _closed_on_error(store):
        with store.read() as connection:
            found = connection.exec_driver_sql("PRAGMA application_id").scalar_one()
            version = connection.exec_driver_sql("PRAGMA user_version").scalar_one()
            # reading the schema touches the file's structure, so that a cut or overwritten file shows now
            connection.exec_driver_sql("SELECT count(*) FROM sqlite_master").scalar_one()
        if found != APPLICATION_ID:
            raise ProjectError(f"{path}: is an SQLite database, but not one of annotator's; restore it from a backup")
        if version != migrations[-1].version:
            with store.write() as connection:
                upgrade(connection, path, migrations)
    return store


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
        # FULL waits for the disk at every commit (NORMAL in WAL mode may lose the last ones in a power cut):
        # an operator's click is acknowledged only once it is safe, and a commit takes milliseconds
        connection.execute("PRAGMA synchronous = FULL")
        # without this, the rows that INSERT OR REPLACE removes would pass the append-only triggers by
        connection.execute("PRAGMA recursive_triggers = ON")
        return connection

    engine = create_engine("sqlite://", creator=connect, poolclass=QueuePool, pool_size=THREADS, max_overflow=THREADS)

    @event.listens_for(engine, "begin")
    def begin(connection: Connection) -> None:
        connection.exec_driver_sql(connection.get_execution_options().get(_BEGIN, "BEGIN"))

    return Store(path, engine, clock)
