"""Version 1: recordings, frames, the append-only events and the tables derived from them."""

from __future__ import annotations

_RECORDINGS = """
CREATE TABLE recordings (
    id INTEGER PRIMARY KEY,
    path TEXT NOT NULL UNIQUE,
    format TEXT NOT NULL,
    name TEXT NOT NULL UNIQUE,
    is_sequence INTEGER NOT NULL CHECK (is_sequence IN (0, 1)),
    up TEXT,
    added_ns INTEGER NOT NULL
)
"""

# position: index in the latest scan; NULL if that scan did not find the frame
_FRAMES = """
CREATE TABLE frames (
    id INTEGER PRIMARY KEY,
    recording_id INTEGER NOT NULL REFERENCES recordings (id),
    "key" TEXT NOT NULL,
    position INTEGER,
    revision INTEGER NOT NULL DEFAULT 0,
    finalised INTEGER NOT NULL DEFAULT 0 CHECK (finalised IN (0, 1)),
    UNIQUE (recording_id, "key")
)
"""
_FRAMES_INDEX = "CREATE INDEX frames_in_order ON frames (recording_id, position)"

# An event belongs to a frame, or to a pseudo-view without a frame; `revision` counts within that frame or view.
_EVENTS = """
CREATE TABLE events (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    frame_id INTEGER REFERENCES frames (id),
    view_id TEXT,
    revision INTEGER NOT NULL CHECK (revision > 0),
    kind TEXT NOT NULL,
    payload TEXT NOT NULL,
    author TEXT NOT NULL CHECK (author <> ''),
    time_ns INTEGER NOT NULL,
    source TEXT NOT NULL CHECK (source IN ('manual', 'auto', 'imported')),
    CHECK (frame_id IS NOT NULL OR view_id IS NOT NULL)
)
"""
_EVENTS_OF_FRAME = "CREATE UNIQUE INDEX events_of_frame ON events (frame_id, revision) WHERE frame_id IS NOT NULL"
_EVENTS_OF_VIEW = "CREATE UNIQUE INDEX events_of_view ON events (view_id, revision) WHERE frame_id IS NULL"

_NO_UPDATE = """
CREATE TRIGGER events_are_not_updated BEFORE UPDATE ON events
BEGIN SELECT RAISE (ABORT, 'events are append-only'); END
"""
_NO_DELETE = """
CREATE TRIGGER events_are_not_deleted BEFORE DELETE ON events
BEGIN SELECT RAISE (ABORT, 'events are append-only'); END
"""
# REPLACE deletes a conflicting row without firing the trigger above (unless recursive_triggers is on)
_NO_REPLACE = """
CREATE TRIGGER events_are_not_replaced BEFORE INSERT ON events
WHEN EXISTS (
    SELECT 1 FROM events WHERE id = NEW.id
    OR (frame_id = NEW.frame_id AND revision = NEW.revision)
    OR (frame_id IS NULL AND NEW.frame_id IS NULL AND view_id = NEW.view_id AND revision = NEW.revision)
)
BEGIN SELECT RAISE (ABORT, 'events are append-only'); END
"""

_LABELS = """
CREATE TABLE labels (
    id INTEGER PRIMARY KEY,
    uid TEXT NOT NULL UNIQUE,
    frame_id INTEGER NOT NULL REFERENCES frames (id),
    label TEXT NOT NULL,
    box TEXT NOT NULL,
    score REAL,
    source TEXT NOT NULL,
    state TEXT NOT NULL CHECK (state IN ('proposed', 'accepted', 'edited', 'rejected')),
    author TEXT NOT NULL,
    time_ns INTEGER NOT NULL,
    track_id INTEGER,
    view_disagreement REAL,
    kept_share REAL,
    last_change REAL,
    proposal_event_id INTEGER REFERENCES events (id),
    event_id INTEGER NOT NULL REFERENCES events (id)
)
"""
_LABELS_INDEX = "CREATE INDEX labels_of_frame ON labels (frame_id, state)"

_IMAGE_LABELS = """
CREATE TABLE image_labels (
    frame_id INTEGER PRIMARY KEY REFERENCES frames (id),
    box_kind TEXT NOT NULL CHECK (box_kind IN ('box', 'silhouette')),
    boxes TEXT NOT NULL,
    count INTEGER NOT NULL,
    author TEXT NOT NULL,
    time_ns INTEGER NOT NULL,
    source TEXT NOT NULL,
    event_id INTEGER NOT NULL REFERENCES events (id)
)
"""

_VIEW_LABELS = """
CREATE TABLE view_labels (
    id INTEGER PRIMARY KEY,
    view_id TEXT NOT NULL,
    frame_id INTEGER REFERENCES frames (id),
    revision INTEGER NOT NULL,
    box_kind TEXT NOT NULL CHECK (box_kind IN ('box', 'silhouette')),
    boxes TEXT NOT NULL,
    count INTEGER NOT NULL,
    step INTEGER,
    geometry TEXT,
    author TEXT NOT NULL,
    time_ns INTEGER NOT NULL,
    source TEXT NOT NULL,
    event_id INTEGER NOT NULL REFERENCES events (id)
)
"""
_VIEW_LABELS_INDEX = "CREATE UNIQUE INDEX one_label_a_view ON view_labels (view_id, ifnull(frame_id, 0))"
_VIEW_LABELS_FRAME = "CREATE INDEX view_labels_of_frame ON view_labels (frame_id)"

STATEMENTS = (
    _RECORDINGS,
    _FRAMES,
    _FRAMES_INDEX,
    _EVENTS,
    _EVENTS_OF_FRAME,
    _EVENTS_OF_VIEW,
    _NO_UPDATE,
    _NO_DELETE,
    _NO_REPLACE,
    _LABELS,
    _LABELS_INDEX,
    _IMAGE_LABELS,
    _VIEW_LABELS,
    _VIEW_LABELS_INDEX,
    _VIEW_LABELS_FRAME,
)
