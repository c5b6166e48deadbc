"""Projects of older database versions, written without the store."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path

from store_samples import lost_object

from annotator.project import create_project
from annotator.project.event_types import FrameFinalised, ProposalsReplaced, ProposedObject
from annotator.project.migrations import APPLICATION_ID, MIGRATIONS
from annotator.project.records import ProposalRecord
from annotator.types import Proposal

# The version before the newest.
OLDER = MIGRATIONS[-2].version

Event = ProposalsReplaced | FrameFinalised


def replaced_by(uid: str, proposal: Proposal) -> ProposalsReplaced:
    """The event of one proposal and one lost object."""
    made = ProposedObject(uid=uid, proposal=ProposalRecord.of(proposal))
    return ProposalsReplaced(objects=(made,), lost=(lost_object(),))


def version_one(root: Path, frames: Mapping[str, Sequence[Event]]) -> Path:
    """The project `old` of class hand.

    Args:
        frames: the events of each frame, by its key.
    """
    create_project(root, "old", ["hand"]).close()
    path = root / "old" / "project.db"
    path.unlink()
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    for statement in MIGRATIONS[0].statements:
        connection.execute(statement)
    connection.execute("PRAGMA user_version = 1")
    connection.execute("INSERT INTO recordings VALUES (1, '/take', 'rgbd', 'take', 1, NULL, 7)")
    for number, (key, events) in enumerate(frames.items(), 1):
        is_final = any(isinstance(event, FrameFinalised) for event in events)
        row = (number, key, number - 1, len(events), is_final)
        connection.execute("INSERT INTO frames VALUES (?, 1, ?, ?, ?, ?)", row)
        for revision, event in enumerate(events, 1):
            connection.execute(
                "INSERT INTO events VALUES (NULL, ?, NULL, ?, ?, ?, 'ann', 5, 'auto')",
                (number, revision, event.kind, event.model_dump_json()),
            )
    connection.commit()
    connection.close()
    return path.parent


def make_older(database: Path) -> None:
    """Replaces a closed database by one without what the last migration adds."""
    older = database.with_name("older.db")
    with closing(sqlite3.connect(older, isolation_level=None)) as connection:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        connection.execute("BEGIN")
        for migration in MIGRATIONS[:-1]:
            for statement in migration.statements:
                connection.execute(statement)
        connection.execute("COMMIT")
        connection.execute(f"PRAGMA user_version = {OLDER}")
        connection.execute("ATTACH ? AS newer", (str(database),))
        for (table,) in connection.execute("SELECT name FROM main.sqlite_master WHERE type = 'table'").fetchall():
            names = ", ".join(f'"{row[1]}"' for row in connection.execute(f"PRAGMA main.table_info({table})"))
            connection.execute(f"DELETE FROM main.{table}")  # a migration may have put rows into it
            connection.execute(f"INSERT INTO main.{table} ({names}) SELECT {names} FROM newer.{table}")
    older.replace(database)
