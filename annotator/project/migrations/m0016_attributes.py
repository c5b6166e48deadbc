"""Version 16: values of attributes, of labels (`labels.attributes`) and of frames; both are derived, as JSON objects.

Changes of the project's classes are events that belong to no frame; their `view_id` is `classes`.
"""

from __future__ import annotations

_LABELS = "ALTER TABLE labels ADD COLUMN attributes TEXT NOT NULL DEFAULT '{}'"
_FRAMES = """
CREATE TABLE frame_attributes (
    frame_id INTEGER PRIMARY KEY REFERENCES frames (id),
    attributes TEXT NOT NULL,
    event_id INTEGER NOT NULL REFERENCES events (id)
)
"""
_EVENTS = "CREATE INDEX class_events ON events (id) WHERE kind = 'classes_changed'"
_TRACKS = "CREATE INDEX labels_of_track ON labels (track_id) WHERE track_id IS NOT NULL"

STATEMENTS = (_LABELS, _FRAMES, _EVENTS, _TRACKS)
