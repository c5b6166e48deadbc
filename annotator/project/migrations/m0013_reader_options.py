"""Version 13: recordings keep the options of their reader; two with the same path may differ in them."""

from __future__ import annotations

# SQLite cannot drop the constraint UNIQUE (path), so the table is made anew. Rows that refer to it are checked at the
# end of the transaction. options: JSON; '' = none
_RECORDINGS = """
CREATE TABLE recordings (
    id INTEGER PRIMARY KEY,
    path TEXT NOT NULL,
    format TEXT NOT NULL,
    name TEXT NOT NULL UNIQUE,
    is_sequence INTEGER NOT NULL CHECK (is_sequence IN (0, 1)),
    up TEXT,
    added_ns INTEGER NOT NULL,
    options TEXT NOT NULL DEFAULT '',
    UNIQUE (path, options)
)
"""

STATEMENTS = (
    "PRAGMA defer_foreign_keys = ON",
    "CREATE TABLE recordings_before AS SELECT * FROM recordings",
    "DROP TABLE recordings",
    _RECORDINGS,
    "INSERT INTO recordings SELECT *, '' FROM recordings_before",
    "DROP TABLE recordings_before",
)
