"""Whether a database is sound, and has exactly the tables of its version."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from pathlib import Path

from annotator.project.backup.snapshot import reading
from annotator.project.database.migrations import application_problem, newest_version, schema_problems
from annotator.project.database.store import LOCKED, is_lock
from annotator.types.errors import ProjectError

_MOST_PROBLEMS = 20


def database_problems(path: Path) -> list[str]:
    """The problems of the database `path`, of any version; empty for a sound one.

    Nothing in the file is trusted: its schema is compared as text before any of its tables is read.

    Raises:
        ProjectError: another process has locked it, so that nothing is known.
    """
    try:
        with reading(path) as connection:
            connection.execute("BEGIN")
            return list(_problems(connection))
    except sqlite3.Error as error:
        if is_lock(error):
            raise ProjectError(f"{path}: {LOCKED}") from error
        return [f"cannot be read: {error}"]


def missing_events(connection: sqlite3.Connection) -> int:
    """How many events have been deleted: events are never deleted, so their ids have no gaps.

    Raises:
        sqlite3.Error: the database cannot be read.
    """
    return given_id(connection, "events") - int(connection.execute("SELECT count(*) FROM events").fetchone()[0])


def given_id(connection: sqlite3.Connection, table: str) -> int:
    """The last id that a table has given, whether or not its row is still there; 0 if none is known."""
    try:
        row = connection.execute("SELECT seq FROM sqlite_sequence WHERE name = ?", (table,)).fetchone()
        return int(row[0]) if row is not None else 0
    except (sqlite3.Error, ValueError, TypeError):
        return 0


def _problems(connection: sqlite3.Connection) -> Iterator[str]:
    if problem := application_problem(connection.execute("PRAGMA application_id").fetchone()[0]):
        yield problem
        return
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if not 1 <= version <= newest_version():
        yield f"has database version {version}; this annotator knows versions 1 to {newest_version()}"
        return
    differences = list(schema_problems(connection, version))
    yield from differences
    lines = [str(row[0]) for row in connection.execute(f"PRAGMA integrity_check({_MOST_PROBLEMS})")]
    yield from (line for line in lines if line != "ok")
    if differences or lines != ["ok"]:
        return
    orphans = connection.execute("PRAGMA foreign_key_check").fetchmany(_MOST_PROBLEMS)
    yield from (f"table {row[0]}, row {row[1]}: refers to a missing row of {row[2]}" for row in orphans)
    yield from _event_problems(connection)


def _event_problems(connection: sqlite3.Connection) -> Iterator[str]:
    """Frames that have lost events, as far as revisions tell; `verify --deep` finds the rest."""
    rows = connection.execute(
        'SELECT frames."key", frames.revision, max(events.revision) AS last FROM events '
        "JOIN frames ON frames.id = events.frame_id GROUP BY frames.id HAVING last > frames.revision"
    )
    for key, revision, last in rows.fetchmany(_MOST_PROBLEMS):
        yield f"frame {key}: is at revision {revision}, but has an event of revision {last}"
