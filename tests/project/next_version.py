"""An example of a migration: the database of the next release."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from annotator.project.database import migrations
from annotator.project.database.migrations import MIGRATIONS, Migration, newest_version

NOW = newest_version()
NEXT = Migration(
    NOW + 1, ("ALTER TABLE runs ADD COLUMN note TEXT", "CREATE INDEX labels_by_author ON labels (author, time_ns)")
)


def use_next(patch: pytest.MonkeyPatch, next_one: Migration = NEXT) -> None:
    """From now on, this process has the annotator of the next release."""
    patch.setattr(migrations, "MIGRATIONS", (*MIGRATIONS, next_one))


def version_of(database: Path) -> int:
    """The version of a database."""
    with closing(sqlite3.connect(database)) as connection:
        return int(connection.execute("PRAGMA user_version").fetchone()[0])
