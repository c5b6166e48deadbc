"""Numbered migrations that upgrade a database of any older version to the newest one.

A released migration is never changed, since databases of its version exist. The version is SQLite's `user_version`; it
changes in the same transaction as the tables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import Connection

from annotator.project.migrations import (
    m0001_events,
    m0002_batch,
    m0003_label_runs,
    m0004_packed,
    m0005_actions,
    m0006_agreement,
    m0007_moves,
    m0008_tracks,
    m0009_iou_loss,
    m0010_suggestions,
    m0011_box_kind,
    m0012_labels_by_class,
    m0013_reader_options,
    m0014_adjustments,
    m0015_generation,
    m0016_attributes,
    m0017_removed,
    m0018_said,
    m0019_hashes,
)
from annotator.types.errors import ProjectError

APPLICATION_ID = 0x416E6E6F  # "Anno": distinguishes project databases from other SQLite files


@dataclass(frozen=True)
class Migration:
    """One migration.

    Attributes:
        version: the version after it, from 1 without gaps.
        statements: SQL, run in order.
    """

    version: int
    statements: tuple[str, ...]


MIGRATIONS: tuple[Migration, ...] = (
    Migration(1, m0001_events.STATEMENTS),
    Migration(2, m0002_batch.STATEMENTS),
    Migration(3, m0003_label_runs.STATEMENTS),
    Migration(4, m0004_packed.STATEMENTS),
    Migration(5, m0005_actions.STATEMENTS),
    Migration(6, m0006_agreement.STATEMENTS),
    Migration(7, m0007_moves.STATEMENTS),
    Migration(8, m0008_tracks.STATEMENTS),
    Migration(9, m0009_iou_loss.STATEMENTS),
    Migration(10, m0010_suggestions.STATEMENTS),
    Migration(11, m0011_box_kind.STATEMENTS),
    Migration(12, m0012_labels_by_class.STATEMENTS),
    Migration(13, m0013_reader_options.STATEMENTS),
    Migration(14, m0014_adjustments.STATEMENTS),
    Migration(15, m0015_generation.STATEMENTS),
    Migration(16, m0016_attributes.STATEMENTS),
    Migration(17, m0017_removed.STATEMENTS),
    Migration(18, m0018_said.STATEMENTS),
    Migration(19, m0019_hashes.STATEMENTS),
)


def require_known(version: int, path: Path, migrations: Sequence[Migration]) -> None:
    """Refuses a database of a version after the last of `migrations`.

    Args:
        path: the database file, for messages.

    Raises:
        ProjectError: it is newer.
    """
    newest = migrations[-1].version
    if version > newest:
        raise ProjectError(
            f"{path}: was written by a newer annotator (database version {version}, this one supports up to {newest}); "
            "update annotator"
        )


def upgrade(connection: Connection, path: Path, migrations: Sequence[Migration]) -> None:
    """Runs the missing migrations, within the caller's write transaction.

    Args:
        path: the database file, for messages.

    Raises:
        ProjectError: the database is newer than the last of `migrations`.
    """
    version = connection.exec_driver_sql("PRAGMA user_version").scalar_one()
    require_known(version, path, migrations)
    for migration in migrations:
        if migration.version > version:
            for statement in migration.statements:
                connection.exec_driver_sql(statement)
            connection.exec_driver_sql(f"PRAGMA user_version = {migration.version}")
