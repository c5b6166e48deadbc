"""Version 2: batch runs with the results of their frames, and the registry of trained models."""

from __future__ import annotations

_RUNS = """
CREATE TABLE runs (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    "key" TEXT NOT NULL,
    image_detector TEXT NOT NULL,
    view_detector TEXT NOT NULL,
    config TEXT NOT NULL,
    started_ns INTEGER NOT NULL,
    finished_ns INTEGER
)
"""

# The newest row of a frame has the highest id: processing it again under a key replaces its row.
_FRAME_RESULTS = """
CREATE TABLE frame_results (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    frame_id INTEGER NOT NULL REFERENCES frames (id),
    "key" TEXT NOT NULL,
    run_id INTEGER NOT NULL REFERENCES runs (id),
    status TEXT NOT NULL CHECK (status IN ('done', 'failed')),
    reason TEXT,
    seconds REAL NOT NULL,
    proposals INTEGER NOT NULL,
    time_ns INTEGER NOT NULL,
    UNIQUE (frame_id, "key"),
    CHECK ((status = 'failed') = (reason IS NOT NULL))
)
"""
_RESULTS_OF_RUN = "CREATE INDEX frame_results_of_run ON frame_results (run_id)"

_MODELS = """
CREATE TABLE models (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    role TEXT NOT NULL CHECK (role IN ('image', 'view')),
    path TEXT NOT NULL,
    created_ns INTEGER NOT NULL,
    labels TEXT NOT NULL,
    box_kind TEXT NOT NULL CHECK (box_kind IN ('box', 'silhouette')),
    metrics TEXT NOT NULL,
    manifest TEXT,
    fingerprint TEXT NOT NULL,
    active INTEGER NOT NULL CHECK (active IN (0, 1))
)
"""
_ONE_ACTIVE = "CREATE UNIQUE INDEX one_active_model_a_role ON models (role) WHERE active = 1"

STATEMENTS = (_RUNS, _FRAME_RESULTS, _RESULTS_OF_RUN, _MODELS, _ONE_ACTIVE)
