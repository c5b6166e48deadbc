"""Whether a database has the tables and columns that this version reads and writes."""

from __future__ import annotations

from pathlib import Path

from sqlalchemy import Connection

from annotator.project.schema import METADATA
from annotator.types.errors import RESTORE, ProjectError

# SQLite's messages about statements that do not fit the tables; all have the general code SQLITE_ERROR.
MISFITS = ("no such table", "no such column", "has no column", "already exists", "duplicate column")

_COLUMNS = "SELECT m.name, c.name FROM sqlite_master AS m JOIN pragma_table_info(m.name) AS c WHERE m.type = 'table'"


def require_tables(connection: Connection, path: Path) -> None:
    """Checks the tables of a database of the newest version.

    Args:
        path: the database file, for messages.

    Raises:
        ProjectError: a table or a column is missing.
    """
    found = {(table, column) for table, column in connection.exec_driver_sql(_COLUMNS)}
    tables = {table for table, _ in found}
    missing = [f"table {table.name}" for table in METADATA.sorted_tables if table.name not in tables]
    missing += [
        f"column {column.name} of table {table.name}"
        for table in METADATA.sorted_tables
        for column in table.columns
        if table.name in tables and (table.name, column.name) not in found
    ]
    if missing:
        raise ProjectError(f"{path}: is damaged: it lacks {', '.join(missing)}; {RESTORE}")
