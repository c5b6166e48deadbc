"""The tables of the newest database version for SQLAlchemy, read from what the migrations make."""

from __future__ import annotations

import zlib
from typing import Any

from sqlalchemy import Boolean, Column, Dialect, Float, ForeignKey, Integer, MetaData, Table, Text, bindparam, select
from sqlalchemy.types import TypeDecorator

from annotator.project.database.migrations import MIGRATIONS, in_memory
from annotator.types.errors import RESTORE, ProjectError

# Length in characters from which texts are compressed; shorter ones gain little and stay readable in SQLite tools.
PACKED_FROM = 1000

# A row of a query, with its columns as attributes (SQLAlchemy's `Row` cannot be checked at run time).
AnyRow = Any


class PackedText(TypeDecorator[str]):
    """Text; long texts are stored as zlib-compressed blobs."""

    impl = Text
    cache_ok = True

    def process_bind_param(self, value: str | None, dialect: Dialect) -> str | bytes | None:
        """Converts a value from Python to the database."""
        return value if value is None or len(value) < PACKED_FROM else zlib.compress(value.encode())

    def process_result_value(self, value: str | bytes | None, dialect: Dialect) -> str | None:
        """Converts a value from the database to Python."""
        if not isinstance(value, bytes):
            return value
        try:
            return zlib.decompress(value).decode()
        except (zlib.error, UnicodeDecodeError) as error:
            raise ProjectError(f"an event of the project is damaged ({error}); {RESTORE}") from error


# Types of columns in the SQL of the migrations.
_TYPES = {"INTEGER": Integer, "BOOLEAN": Boolean, "REAL": Float, "TEXT": Text, "PACKED_TEXT": PackedText}


def _tables() -> MetaData:
    """The tables that the migrations make."""
    found = MetaData()
    with in_memory(MIGRATIONS) as made:
        for (name,) in made.execute("SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'"):
            to = {row[3]: f"{row[2]}.{row[4]}" for row in made.execute(f"PRAGMA foreign_key_list({name})")}
            columns = [
                Column(
                    column,
                    _TYPES[kind](),
                    *([ForeignKey(to[column])] if column in to else []),
                    primary_key=bool(is_key),
                    nullable=not (is_required or is_key),
                )
                for _, column, kind, is_required, _, is_key in made.execute(f"PRAGMA table_info({name})")
            ]
            Table(name, found, *columns)
    return found


_FOUND = _tables().tables
recordings = _FOUND["recordings"]
moves = _FOUND["moves"]
frames = _FOUND["frames"]
events = _FOUND["events"]
labels = _FOUND["labels"]
frame_attributes = _FOUND["frame_attributes"]
image_labels = _FOUND["image_labels"]
view_labels = _FOUND["view_labels"]
revertible = _FOUND["revertible"]
adjustments = _FOUND["adjustments"]
removed_rows = _FOUND["removed_rows"]
runs = _FOUND["runs"]
frame_results = _FOUND["frame_results"]
models = _FOUND["models"]

# Queries of many modules, built once, since building a statement takes longer than running it.
LABEL_OF_UID = select(labels).where(labels.c.uid == bindparam("uid"))
LABELS_OF_FRAME = select(labels).where(labels.c.frame_id == bindparam("frame")).order_by(labels.c.id)

DERIVED = (labels, image_labels, view_labels, revertible, adjustments, frame_attributes, removed_rows)
