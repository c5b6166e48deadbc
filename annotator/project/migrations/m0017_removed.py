"""Version 17: recordings can be removed, and one that has moved is recognised by the content of a frame.

- removed_ns, removed_by: when and by whom; NULL = in the project.
- fingerprint: SHA-256 (hex) of a frame that could be read, `:`, and its key; NULL = not known yet.
- removed_rows: rows of derived tables (`name`) of removed recordings, as JSON, with the ids of labels; derived.
"""

from __future__ import annotations

_REMOVED_ROWS = """
CREATE TABLE removed_rows (
    id INTEGER PRIMARY KEY,
    recording_id INTEGER NOT NULL REFERENCES recordings (id),
    name TEXT NOT NULL,
    label_id INTEGER,
    content TEXT NOT NULL
)
"""
_BY_RECORDING = "CREATE INDEX removed_rows_of_recording ON removed_rows (recording_id, name)"
_BY_LABEL = "CREATE INDEX removed_labels ON removed_rows (label_id) WHERE label_id IS NOT NULL"

STATEMENTS = (
    "ALTER TABLE recordings ADD COLUMN removed_ns INTEGER",
    "ALTER TABLE recordings ADD COLUMN removed_by TEXT",
    "ALTER TABLE recordings ADD COLUMN fingerprint TEXT",
    _REMOVED_ROWS,
    _BY_RECORDING,
    _BY_LABEL,
)
