"""Version 5: events hold their action, the action it undoes, and its effort; labels hold their origin.

An action is one step of an operator; all its events share an id. `undoes` is the action that it reverts: for a redo,
the action of the undo. `actions` (drags, clicks, keys) and `seconds` are the effort; `subject` is the label or draft
that it was for.

`revertible` is derived from the events. It holds, for each event of an action, the state of its subject (the label,
boxes or frame that it changes) before and after it, so that undo needs no replay. NULL = absent.
"""

from __future__ import annotations

_EVENTS = (
    "ALTER TABLE events ADD COLUMN action TEXT",
    "ALTER TABLE events ADD COLUMN undoes TEXT",
    "ALTER TABLE events ADD COLUMN subject TEXT",
    "ALTER TABLE events ADD COLUMN actions INTEGER",
    "ALTER TABLE events ADD COLUMN seconds REAL",
    "CREATE INDEX events_of_action ON events (action) WHERE action IS NOT NULL",
    "CREATE INDEX actions_of_author ON events (author, id) WHERE action IS NOT NULL",
)

_LABELS = (
    "ALTER TABLE labels ADD COLUMN origin TEXT",
    "ALTER TABLE labels ADD COLUMN image_box TEXT",
)

_REVERTIBLE = """
CREATE TABLE revertible (
    event_id INTEGER PRIMARY KEY REFERENCES events (id),
    subject TEXT NOT NULL,
    "before" TEXT,
    "after" TEXT
)
"""
_BY_SUBJECT = "CREATE INDEX revertible_by_subject ON revertible (subject, event_id)"

STATEMENTS = (*_EVENTS, *_LABELS, _REVERTIBLE, _BY_SUBJECT)
