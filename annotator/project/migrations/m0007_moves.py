"""Version 7: a log of the moves of recording folders, with the path before and after."""

from __future__ import annotations

_MOVES = """
CREATE TABLE moves (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    recording_id INTEGER NOT NULL REFERENCES recordings (id),
    path_before TEXT NOT NULL,
    path_after TEXT NOT NULL,
    author TEXT NOT NULL CHECK (author <> ''),
    time_ns INTEGER NOT NULL
)
"""
_NO_UPDATE = """
CREATE TRIGGER moves_are_not_updated BEFORE UPDATE ON moves
BEGIN SELECT RAISE (ABORT, 'moves are append-only'); END
"""
_NO_DELETE = """
CREATE TRIGGER moves_are_not_deleted BEFORE DELETE ON moves
BEGIN SELECT RAISE (ABORT, 'moves are append-only'); END
"""
_NO_REPLACE = """
CREATE TRIGGER moves_are_not_replaced BEFORE INSERT ON moves
WHEN EXISTS (SELECT 1 FROM moves WHERE id = NEW.id)
BEGIN SELECT RAISE (ABORT, 'moves are append-only'); END
"""

STATEMENTS = (_MOVES, _NO_UPDATE, _NO_DELETE, _NO_REPLACE)
