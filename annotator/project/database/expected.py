"""The tables, indexes, triggers and views of each database version, compared as text.

Nothing in a database is trusted: a trigger or a view of a stranger would run with each change.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from functools import lru_cache
from pathlib import Path

from annotator.project.migrations import MIGRATIONS
from annotator.types.errors import RESTORE, ProjectError

# Tables that SQLite's ANALYZE makes.
_STATISTICS = ("sqlite_stat1", "sqlite_stat4")

Schema = dict[tuple[str, str], tuple[str, str]]
"""(type, name) -> (table, normalised SQL)"""


def require_own_triggers(connection: sqlite3.Connection, path: Path) -> None:
    """Checks that a database has only triggers and views that some version of annotator has made.

    Args:
        path: the database file, for messages.

    Raises:
        ProjectError: there is another one. Nothing has been changed.
    """
    for (kind, name), made in read_schema(connection).items():
        if kind in ("trigger", "view") and (kind, name, *made) not in _own_triggers():
            raise ProjectError(
                f"{path}: has the {kind} {name!r}, which does not belong to a project, so it was not opened. "
                f"`annotator project repair` makes a new project of the labels, without it; or {RESTORE}"
            )


@lru_cache(maxsize=1)
def _own_triggers() -> frozenset[tuple[str, ...]]:
    """The triggers and views of all versions: kind, name, table, normalised SQL."""
    found: set[tuple[str, ...]] = set()
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
        connection.execute("BEGIN")
        for migration in MIGRATIONS:
            for statement in migration.statements:
                connection.execute(statement)
            found |= {(*key, *made) for key, made in read_schema(connection).items() if key[0] in ("trigger", "view")}
    return frozenset(found)


def schema_problems(found: Schema, expected: Schema) -> Iterator[str]:
    """The differences between two schemas, in words."""
    for kind, name in sorted(expected.keys() - found.keys()):
        yield f"lacks the {kind} {name}"
    for kind, name in sorted(found.keys() - expected.keys()):
        if name not in _STATISTICS:
            yield f"has the {kind} {name!r}, which does not belong to a project"
    for kind, name in sorted(found.keys() & expected.keys()):
        if found[kind, name] != expected[kind, name]:
            yield f"the {kind} {name} is not that of a project"


def read_schema(connection: sqlite3.Connection) -> Schema:
    """The schema of a database, as text."""
    rows = connection.execute("SELECT type, name, tbl_name, sql FROM sqlite_master")
    return {(kind, name): (table, " ".join((sql or "").split())) for kind, name, table, sql in rows}


@lru_cache(maxsize=32)
def expected_schema(version: int) -> Schema:
    """The schema of a database version, made by its migrations."""
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
        connection.execute("BEGIN")
        for migration in MIGRATIONS[:version]:
            for statement in migration.statements:
                connection.execute(statement)
        return read_schema(connection)
