"""The schema of a project's database, as migrations: each is SQL that upgrades a database by one version, from 0.

A released migration is never changed, since databases of its version exist. The version is SQLite's `user_version`; it
changes in the same transaction as the tables.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from functools import lru_cache
from itertools import chain

from annotator.types.errors import RESTORE

Migration = tuple[str, ...]
"""The statements of one migration, in order."""

APPLICATION_ID = 0x416E6E51  # "AnnQ": distinguishes project databases from other SQLite files


def newest_version() -> int:
    """The version of new databases."""
    return len(MIGRATIONS)


def version_problem(connection: sqlite3.Connection) -> str | None:
    """Why a database is none that this annotator can read; None if it is one."""
    application_id, version = (
        connection.execute(f"PRAGMA {name}").fetchone()[0] for name in ("application_id", "user_version")
    )
    if application_id != APPLICATION_ID:
        return f"is an SQLite database, but not a project database; {RESTORE}"
    if version < 1:
        return f"is damaged: its version is {version}; {RESTORE}"
    if version > newest_version():
        return (
            f"was written by a newer annotator (database version {version}, this one supports up to "
            f"{newest_version()}); update annotator"
        )
    return None


def upgrade(connection: sqlite3.Connection) -> None:
    """Runs the missing migrations, within the caller's write transaction."""
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    for statement in chain.from_iterable(MIGRATIONS[version:]):
        connection.execute(statement)
    connection.execute(f"PRAGMA user_version = {newest_version()}")


# --- comparing a schema, as text --------------------------------------------------------------------------------------

Schema = dict[tuple[str, str], tuple[str, str]]
"""(type, name) -> (table, normalised SQL)"""

# Tables that SQLite's ANALYZE makes.
_STATISTICS = ("sqlite_stat1", "sqlite_stat4")


def schema_problems(connection: sqlite3.Connection) -> Iterator[str]:
    """How the schema of a database differs from that of its version, in words.

    Nothing in a database is trusted: a trigger or a view of a stranger would run with each change.
    """
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    found, expected = _read_schema(connection), _schema_of(MIGRATIONS[:version])
    # the tables first: others lack with them
    for kind, name in sorted(expected.keys() - found.keys(), key=lambda each: (each[0] != "table", each)):
        yield f"lacks the {kind} {name}"
    for kind, name in sorted(found.keys() - expected.keys()):
        if name not in _STATISTICS:
            yield f"has the {kind} {name!r}, which does not belong to a project"
    for kind, name in sorted(found.keys() & expected.keys()):
        if found[kind, name] != expected[kind, name]:
            yield f"the {kind} {name} is not that of a project"


def _read_schema(connection: sqlite3.Connection) -> Schema:
    rows = connection.execute("SELECT type, name, tbl_name, sql FROM sqlite_master")
    return {(kind, name): (table, " ".join((sql or "").split())) for kind, name, table, sql in rows}


@lru_cache(maxsize=8)
def _schema_of(migrations: tuple[Migration, ...]) -> Schema:
    with in_memory(migrations) as connection:
        return _read_schema(connection)


@contextmanager
def in_memory(migrations: Sequence[Migration]) -> Iterator[sqlite3.Connection]:
    """A new database that these migrations have made."""
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
        connection.execute("BEGIN")
        for statement in chain.from_iterable(migrations):
            connection.execute(statement)
        yield connection


# --- version 1 --------------------------------------------------------------------------------------------------------


def _append_only(table: str) -> tuple[str, ...]:
    """Triggers that protect the rows of a table; with `recursive_triggers`, REPLACE deletes rows, too."""
    abort = f"BEGIN SELECT RAISE (ABORT, '{table} are append-only'); END"
    return (
        f"CREATE TRIGGER {table}_are_not_updated BEFORE UPDATE ON {table} {abort}",
        f"CREATE TRIGGER {table}_are_not_deleted BEFORE DELETE ON {table} {abort}",
    )


# up: three numbers, as JSON. options: of the reader, as JSON; '' = none. removed_ns, removed_by: when and by whom;
# NULL = in the project. fingerprint: SHA-256 (hex) of a frame that could be read, `:`, and its key; NULL = not known.
# rig_id: the first recording of those that differ only in their camera: they share moments and tracks.
_RECORDINGS = """
CREATE TABLE recordings (
    id INTEGER PRIMARY KEY,
    path TEXT NOT NULL,
    format TEXT NOT NULL,
    name TEXT NOT NULL UNIQUE,
    is_sequence BOOLEAN NOT NULL CHECK (is_sequence IN (0, 1)),
    up TEXT,
    added_ns INTEGER NOT NULL,
    options TEXT NOT NULL,
    removed_ns INTEGER,
    removed_by TEXT,
    fingerprint TEXT,
    rig_id INTEGER NOT NULL REFERENCES recordings (id),
    UNIQUE (path, options)
)
"""
# A frame is what one camera sees of a moment, that is of one cloud. moment_id: that of a frame of the moment.
# cloud: the name of a cloud that several cameras may share; NULL = this camera alone has it. pose: T_cloud_recorded, a
# matrix of 4 x 4 as JSON, from the frame of the camera (without corrections) to that of the cloud, in which the boxes
# of the moment are stored; NULL = they are the same. position: index in the latest scan; NULL if that scan did not find
# the frame. revision: the same for all frames of a moment. attributes: values, as JSON. run_id: the batch run whose
# proposals it has.
_FRAMES = """
CREATE TABLE frames (
    id INTEGER PRIMARY KEY,
    recording_id INTEGER NOT NULL REFERENCES recordings (id),
    moment_id INTEGER NOT NULL REFERENCES frames (id),
    "key" TEXT NOT NULL,
    cloud TEXT,
    pose TEXT,
    position INTEGER,
    revision INTEGER NOT NULL,
    finalised BOOLEAN NOT NULL CHECK (finalised IN (0, 1)),
    attributes TEXT,
    run_id INTEGER REFERENCES runs (id),
    UNIQUE (recording_id, "key")
)
"""
# position: in the order of the project's classes; NULL = a removed class, or one that was merged, which has the name of
# the other. shortcut: the key that selects it on the page.
_CLASSES = """
CREATE TABLE classes (
    id INTEGER PRIMARY KEY,
    name TEXT NOT NULL,
    position INTEGER,
    colour TEXT,
    shortcut TEXT
)
"""
# content: the definition without the name, as JSON; its classes by their ids.
_ATTRIBUTES = "CREATE TABLE attributes (name TEXT PRIMARY KEY, position INTEGER NOT NULL, content TEXT NOT NULL)"
# rows: JSON; long ones are packed (`PackedText` in schema.py). action: id of the operator's step that it is a part of.
# undoes: the action that it reverts; for a redo, the action of the undo. subject: the label or draft that the effort
# (actions: drags, clicks, keys; seconds) was for, the source of imported boxes, or a change of the classes in words.
_EVENTS = """
CREATE TABLE events (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    frame_id INTEGER REFERENCES frames (id),
    view_id TEXT,
    revision INTEGER NOT NULL CHECK (revision > 0),
    kind TEXT NOT NULL,
    rows PACKED_TEXT NOT NULL,
    author TEXT NOT NULL CHECK (author <> ''),
    time_ns INTEGER NOT NULL,
    source TEXT NOT NULL CHECK (source IN ('manual', 'auto', 'imported')),
    action TEXT,
    undoes TEXT,
    subject TEXT,
    actions INTEGER,
    seconds REAL,
    CHECK (frame_id IS NOT NULL OR view_id IS NOT NULL)
)
"""
# A label belongs to a moment. frame_id: the frame in which it was made, and whose image `image_box` lies on.
# track_linked: whether linking assigned the track id. suggestion: the detector that suggested its boxes. values_set:
# whether a person has set values of its attributes. proposed_box: as the recursion found it. run_id: of the batch run
# that proposed it. behind: uid of the label that is shown in its place, since both see one object. of_source: name of
# the other software that made it. said: what the source says of the object (`StoredSaid`), only where the row does not
# say the same: somebody has changed it, or other sources lend it values. Boxes and texts with several values are JSON.
# Short columns come first: a query of many rows reads no further.
_LABELS = """
CREATE TABLE labels (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    uid TEXT NOT NULL UNIQUE,
    frame_id INTEGER NOT NULL REFERENCES frames (id),
    moment_id INTEGER NOT NULL REFERENCES frames (id),
    class_id INTEGER NOT NULL REFERENCES classes (id),
    hidden BOOLEAN NOT NULL DEFAULT 0 CHECK (hidden IN (0, 1)),
    state TEXT NOT NULL CHECK (state IN ('proposed', 'accepted', 'edited', 'rejected')),
    source TEXT NOT NULL CHECK (source IN ('manual', 'auto', 'imported')),
    score REAL,
    track_id INTEGER,
    track_linked BOOLEAN NOT NULL CHECK (track_linked IN (0, 1)),
    view_disagreement REAL,
    kept_share REAL,
    last_change REAL,
    image_agreement REAL,
    expected_iou_loss REAL,
    box_kind TEXT NOT NULL CHECK (box_kind IN ('box', 'silhouette')),
    values_set BOOLEAN NOT NULL CHECK (values_set IN (0, 1)),
    run_id INTEGER REFERENCES runs (id),
    origin TEXT,
    of_source TEXT,
    behind TEXT,
    author TEXT NOT NULL,
    time_ns INTEGER NOT NULL,
    box TEXT NOT NULL,
    proposed_box TEXT,
    attributes TEXT NOT NULL,
    image_box TEXT,
    suggestion TEXT,
    said TEXT
)
"""
_IMAGE_LABELS = """
CREATE TABLE image_labels (
    frame_id INTEGER PRIMARY KEY REFERENCES frames (id),
    box_kind TEXT NOT NULL CHECK (box_kind IN ('box', 'silhouette')),
    boxes TEXT NOT NULL,
    count INTEGER NOT NULL,
    author TEXT NOT NULL,
    time_ns INTEGER NOT NULL,
    source TEXT NOT NULL,
    event_id INTEGER NOT NULL REFERENCES events (id),
    hidden BOOLEAN NOT NULL DEFAULT 0 CHECK (hidden IN (0, 1))
)
"""
# key: the view's id, a colon, and its frame's id, if it has a frame
_VIEW_LABELS = """
CREATE TABLE view_labels (
    "key" TEXT PRIMARY KEY,
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
    event_id INTEGER NOT NULL REFERENCES events (id),
    hidden BOOLEAN NOT NULL DEFAULT 0 CHECK (hidden IN (0, 1))
)
"""
# The up direction (in the frame of the cloud) and the correction of the calibration, as they were set.
_ADJUSTMENTS = """
CREATE TABLE adjustments (
    recording_id INTEGER PRIMARY KEY REFERENCES recordings (id),
    up TEXT,
    correction TEXT NOT NULL,
    event_id INTEGER NOT NULL REFERENCES events (id)
)
"""
# What the latest automatic pass over a frame has found, also where a reviewed label covers it, as JSON: lists of the id
# of the class, the score, the box in the frame of the cloud, and the edges of its image box (`Proposal.edges`).
_PASSES = """
CREATE TABLE passes (
    frame_id INTEGER PRIMARY KEY REFERENCES frames (id),
    event_id INTEGER NOT NULL REFERENCES events (id),
    content PACKED_TEXT NOT NULL
)
"""
# What people see: without the labels and boxes of removed recordings, and without boxes behind others. A join with the
# classes would be made for every query, and keep SQLite from choosing the order of others.
_SHown_labels = """
CREATE VIEW shown_labels AS
SELECT labels.*, (SELECT classes.name FROM classes WHERE classes.id = labels.class_id) AS label
FROM labels WHERE labels.hidden = 0 AND labels.behind IS NULL
"""
_SHOWN_IMAGE_LABELS = "CREATE VIEW shown_image_labels AS SELECT * FROM image_labels WHERE hidden = 0"
_SHOWN_VIEW_LABELS = "CREATE VIEW shown_view_labels AS SELECT * FROM view_labels WHERE hidden = 0"
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
# sha256: of the weights, in hexadecimal digits, so that a verification finds damaged ones
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
    active BOOLEAN NOT NULL CHECK (active IN (0, 1)),
    sha256 TEXT NOT NULL
)
"""

_INDEXES = (
    "CREATE INDEX frames_in_order ON frames (recording_id, position)",
    # a camera has one frame of a moment
    "CREATE UNIQUE INDEX frames_of_moment ON frames (moment_id, recording_id)",
    "CREATE INDEX frames_of_cloud ON frames (cloud) WHERE cloud IS NOT NULL",
    "CREATE UNIQUE INDEX events_of_frame ON events (frame_id, revision) WHERE frame_id IS NOT NULL",
    "CREATE UNIQUE INDEX events_of_view ON events (view_id, revision) WHERE frame_id IS NULL",
    "CREATE INDEX events_of_action ON events (action) WHERE action IS NOT NULL",
    "CREATE INDEX actions_of_author ON events (author, id) WHERE action IS NOT NULL",
    "CREATE INDEX undone_actions ON events (undoes) WHERE undoes IS NOT NULL",
    "CREATE INDEX adjusting_events ON events (id) WHERE kind = 'recording_adjusted'",
    "CREATE INDEX labels_of_frame ON labels (frame_id, state, hidden, behind)",
    "CREATE INDEX labels_of_moment ON labels (moment_id)",
    "CREATE INDEX labels_by_class ON labels (class_id, state, hidden, behind)",
    "CREATE INDEX labels_of_track ON labels (track_id) WHERE track_id IS NOT NULL",
    # an object has one box in a moment
    "CREATE UNIQUE INDEX one_box_a_track ON labels (moment_id, track_id) "
    "WHERE track_id IS NOT NULL AND state <> 'rejected' AND behind IS NULL",
    "CREATE INDEX labels_behind ON labels (behind) WHERE behind IS NOT NULL",
    "CREATE INDEX view_labels_of_frame ON view_labels (frame_id)",
    "CREATE INDEX frame_results_of_run ON frame_results (run_id)",
    "CREATE UNIQUE INDEX one_active_model_a_role ON models (role) WHERE active = 1",
)

# --- version 2: objects that stand still ------------------------------------------------------------------------------
# frames.world: T_world_cloud, as `pose`: from the frame of the cloud to the world of the rig; NULL = not known. Read
# from the frame that names the moment. recorded_world: the same, as the recording says it; poses may be estimated.
# classes.still: objects of the class stand still; NULL = nobody has said so.

# A track of a rig (its first recording) that stands still: one box, in the frame of the world.
_STILLS = """
CREATE TABLE stills (
    uid TEXT PRIMARY KEY,
    rig_id INTEGER NOT NULL REFERENCES recordings (id),
    track_id INTEGER NOT NULL,
    class_id INTEGER NOT NULL REFERENCES classes (id),
    state TEXT NOT NULL CHECK (state IN ('proposed', 'accepted', 'edited', 'rejected')),
    source TEXT NOT NULL CHECK (source IN ('manual', 'auto', 'imported')),
    box_kind TEXT NOT NULL CHECK (box_kind IN ('box', 'silhouette')),
    values_set BOOLEAN NOT NULL CHECK (values_set IN (0, 1)),
    score REAL,
    expected_iou_loss REAL,
    author TEXT NOT NULL,
    time_ns INTEGER NOT NULL,
    box TEXT NOT NULL,
    attributes TEXT NOT NULL,
    event_id INTEGER NOT NULL REFERENCES events (id)
)
"""
# What each moment sees of a still object. uid: that of the label that it gives, `still_moment`. frame_id: of the camera
# that sees it. points: in the box. hidden_share: of the points in its outline, those before it. place: about where the
# box was, as JSON, when it was looked for; NULL = an operator has had a box of it there. The rows follow from the
# recordings and the stills; those may go and come back, so nothing refers to them.
_SIGHTINGS = """
CREATE TABLE sightings (
    id INTEGER PRIMARY KEY,
    uid TEXT NOT NULL UNIQUE,
    still TEXT NOT NULL,
    frame_id INTEGER NOT NULL REFERENCES frames (id),
    moment_id INTEGER NOT NULL REFERENCES frames (id),
    hidden BOOLEAN NOT NULL DEFAULT 0 CHECK (hidden IN (0, 1)),
    seen BOOLEAN NOT NULL CHECK (seen IN (0, 1)),
    points INTEGER,
    hidden_share REAL,
    place TEXT
)
"""
# Where the camera of a recording was, by its frames: estimated poses, as JSON (`FramePose`). A rig has one such row.
_ESTIMATES = """
CREATE TABLE estimates (
    recording_id INTEGER PRIMARY KEY REFERENCES recordings (id),
    poses TEXT NOT NULL,
    event_id INTEGER NOT NULL REFERENCES events (id)
)
"""
_SIGHTING_KEYS = (("moment", "_id"), ("frame", "_id"), ("still", ""))
# The labels of still objects, where the moment has no row of the track: that is the exception there, or, rejected, says
# that it is not visible. SQLite opens up the union in a query only if the columns have the same affinities. With `+` it
# looks for the moment, which has few rows, not for the track.
_SHOWN_STILLS = """
CREATE VIEW shown_stills AS
SELECT CAST(-sightings.id AS INTEGER) AS id, sightings.uid, sightings.frame_id, sightings.moment_id, stills.class_id,
sightings.hidden, stills.state, stills.source, stills.score, stills.track_id,
CAST(0 AS BOOLEAN) AS track_linked, CAST(NULL AS REAL) AS view_disagreement, CAST(NULL AS REAL) AS kept_share,
CAST(NULL AS REAL) AS last_change, CAST(NULL AS REAL) AS image_agreement, stills.expected_iou_loss,
stills.box_kind, stills.values_set, CAST(NULL AS INTEGER) AS run_id, CAST('still' AS TEXT) AS origin,
CAST(NULL AS TEXT) AS of_source, CAST(NULL AS TEXT) AS behind, stills.author, stills.time_ns, stills.box,
CAST(NULL AS TEXT) AS proposed_box, stills.attributes, CAST(NULL AS TEXT) AS image_box,
CAST(NULL AS TEXT) AS suggestion, CAST(NULL AS TEXT) AS said,
(SELECT classes.name FROM classes WHERE classes.id = stills.class_id) AS label
FROM sightings JOIN stills ON stills.uid = sightings.still
WHERE sightings.hidden = 0 AND sightings.seen = 1 AND NOT EXISTS (
    SELECT 1 FROM labels WHERE labels.moment_id = sightings.moment_id AND +labels.track_id = stills.track_id
    AND labels.behind IS NULL
)
"""

MIGRATIONS: tuple[Migration, ...] = (
    (
        _RECORDINGS,
        _FRAMES,
        _CLASSES,
        _ATTRIBUTES,
        _EVENTS,
        _LABELS,
        _IMAGE_LABELS,
        _VIEW_LABELS,
        _ADJUSTMENTS,
        _PASSES,
        _SHown_labels,
        _SHOWN_IMAGE_LABELS,
        _SHOWN_VIEW_LABELS,
        _RUNS,
        _FRAME_RESULTS,
        _MODELS,
        *_append_only("events"),
        *_INDEXES,
    ),
    (
        "ALTER TABLE frames ADD COLUMN world TEXT",
        "ALTER TABLE frames ADD COLUMN recorded_world TEXT",
        "ALTER TABLE classes ADD COLUMN still BOOLEAN CHECK (still IN (0, 1))",
        _STILLS,
        _SIGHTINGS,
        _ESTIMATES,
        "CREATE UNIQUE INDEX one_still_a_track ON stills (rig_id, track_id) WHERE state <> 'rejected'",
        *(f"CREATE INDEX sightings_of_{of} ON sightings ({of}{id})" for of, id in _SIGHTING_KEYS),
        "DROP VIEW shown_labels",
        _SHown_labels.replace("shown_labels", "shown_rows"),
        _SHOWN_STILLS,
        "CREATE VIEW shown_labels AS SELECT * FROM shown_rows UNION ALL SELECT * FROM shown_stills",
    ),
)
