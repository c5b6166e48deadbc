"""Version 14: the up direction and the correction of the calibration that events set for a recording; derived."""

from __future__ import annotations

_ADJUSTMENTS = """
CREATE TABLE adjustments (
    recording_id INTEGER PRIMARY KEY REFERENCES recordings (id),
    up TEXT,
    correction TEXT NOT NULL,
    event_id INTEGER NOT NULL REFERENCES events (id)
)
"""
_EVENTS = "CREATE INDEX adjusting_events ON events (id) WHERE kind = 'recording_adjusted'"

STATEMENTS = (_ADJUSTMENTS, _EVENTS)
