"""A copy of a database as of one moment, while other processes write to it."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from annotator.project.database.file import database_file
from annotator.project.database.generation import has_foreign_wal
from annotator.project.database.store import BUSY_TIMEOUT_S, explained, foreign_wal
from annotator.types.errors import RESTORE, ProjectError


def write_snapshot(path: Path, out: Path) -> None:
    """Copies the database `path` to the new file `out` by SQLite's online backup: one file, without `-wal`.

    Neither readers nor writers of the database wait.

    Raises:
        ProjectError: it is missing, damaged, locked, or beside a foreign `-wal`; or `out` cannot be written.
    """
    if not path.is_file():
        raise ProjectError(f"{path}: is missing; {RESTORE}")
    if has_foreign_wal(path):
        raise ProjectError(foreign_wal(path))
    with explained(path), reading(path) as source, explained(out), closing(sqlite3.connect(out)) as target:
        # all pages in one step: SQLite begins again if another process writes between two steps
        source.backup(target, pages=-1)
    descriptor = os.open(out, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def reading(path: Path) -> Iterator[sqlite3.Connection]:
    """A connection for one transaction that only reads, and that trusts nothing in the database's schema.

    Raises:
        sqlite3.Error: it cannot be opened or read.
    """
    with closing(
        sqlite3.connect(database_file(path).address, uri=True, timeout=BUSY_TIMEOUT_S, isolation_level=None)
    ) as connection:
        connection.execute("PRAGMA trusted_schema = OFF")
        connection.execute("PRAGMA query_only = ON")
        connection.execute("PRAGMA cell_size_check = ON")
        yield connection
