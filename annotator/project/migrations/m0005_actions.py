"""Version 5: events say which action they belong to, what it undoes and what it cost; labels say how they were made.

An action is what an operator did at once. `undoes` names the action that it takes back (an undo's own action where
it redoes). `subject` names the label or the begun object that `actions` (drags, clicks, keys) and `seconds` went into.

`revertible` follows from the events: for each event of an action, the state of its subject before and after it, so
that undo needs no replay. NULL = it was not there.
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
