"""The tables of a project, read from what the migrations make; they are the truth.

What people change lies in nine tables. One door (`audit/`) writes a changed row, and with it a row of `events`, the
audit: who, when, in which action, from which source, at which revision of the frame; and each changed row as
`[table, key, before, after]`. Of an updated row, `before` and `after` have the columns that differ; of another one, all
that have a value, and null is no row.

- `labels` (key: `uid`): 3D boxes. A label belongs to a *moment*, that is to a cloud at a time, which several cameras
  may share: frames with the same `moment_id`. It names its class by id. Its box lies in the frame of its cloud, as it
  was recorded, so a correction of the calibration moves none. A track has one box in a moment: an index says so. What
  each source says of an object is a row; those `behind` the one that is shown belong to it.
- `stills` (`uid`): objects that stand still; each has one box, in the world of its rig. `sightings` says which moments
  see it, and follows from the recordings. In the views, each of these is a label, unless the moment has a row of the
  track.
- `image_labels` (`frame_id`), `view_labels` (`key`): 2D boxes on camera images and on pseudo-views. In their JSON,
  too, a class is its id (as a text), and the geometry of a view lies in the frame of the cloud.
- `frames` (`id`): only `finalised`, `attributes` and `run_id` are audited; `revision` counts the changes, and the scans
  of a recording change the rest.
- `classes` (`id`), `attributes` (`name`): names, order, looks and definitions. To rename a class or to merge two is a
  change here, and touches no label.
- `adjustments` (`recording_id`): up direction and calibration of a recording.
- `estimates` (`recording_id`): estimated poses of its frames; `frames.world` follows from them.

So undo is generic: where the present columns equal `after`, put `before`. And the audit, replayed from its beginning,
gives these tables. Labels and boxes of a removed recording have `hidden` set. Queries read the views `shown_...`, which
leave them and the boxes behind others out, and give classes by name. The other tables (recordings, runs, results,
models, what the latest pass over a frame has found) have no undo.
"""

from __future__ import annotations

import zlib
from functools import cache
from typing import Any

from sqlalchemy import Boolean, Column, Dialect, Float, ForeignKey, Integer, MetaData, Table, Text, bindparam, select
from sqlalchemy.types import TypeDecorator

from annotator.project.database.migrations import MIGRATIONS, in_memory
from annotator.types.errors import RESTORE, ProjectError

# Length in characters from which texts are compressed; shorter ones gain little and stay readable in SQLite tools.
PACKED_FROM = 1000

# A row of a query, with its columns as attributes (SQLAlchemy's `Row` cannot be checked at run time).
AnyRow = Any


class PackedText(TypeDecorator[str]):
    """Text; long texts are stored as zlib-compressed blobs."""

    impl = Text
    cache_ok = True

    def process_bind_param(self, value: str | None, dialect: Dialect) -> str | bytes | None:
        """Converts a value from Python to the database."""
        return None if value is None else packed(value)

    def process_result_value(self, value: str | bytes | None, dialect: Dialect) -> str | None:
        """Converts a value from the database to Python."""
        return None if value is None else unpacked(value)


def packed(text: str) -> str | bytes:
    """A text as it is stored."""
    if len(text) < PACKED_FROM:
        return text
    # for most texts, zlib takes longer to clear its usual window than to compress them
    packing = zlib.compressobj(1, wbits=13 if len(text) < 8000 else zlib.MAX_WBITS, memLevel=6)
    return packing.compress(text.encode()) + packing.flush()


def unpacked(stored: str | bytes) -> str:
    """The text that `packed` has stored."""
    if isinstance(stored, str):
        return stored
    try:
        return zlib.decompress(stored).decode()
    except (zlib.error, UnicodeDecodeError) as error:
        raise ProjectError(f"an event of the project is damaged ({error}); {RESTORE}") from error


# Types of columns in the SQL of the migrations.
_TYPES = {"INTEGER": Integer, "BOOLEAN": Boolean, "REAL": Float, "TEXT": Text, "PACKED_TEXT": PackedText}


def _tables() -> MetaData:
    """The tables and views that the migrations make."""
    found = MetaData()
    with in_memory(MIGRATIONS) as made:
        names = "SELECT name FROM sqlite_master WHERE type IN ('table', 'view') AND name NOT LIKE 'sqlite_%'"
        for (name,) in made.execute(names).fetchall():
            to = {row[3]: f"{row[2]}.{row[4]}" for row in made.execute(f"PRAGMA foreign_key_list({name})")}
            columns = [
                Column(
                    column,
                    _TYPES[kind or "TEXT"](),  # the name of a class in a view has none
                    *([ForeignKey(to[column])] if column in to else []),
                    primary_key=bool(is_key),
                    nullable=not (is_required or is_key),
                )
                for _, column, kind, is_required, _, is_key in made.execute(f"PRAGMA table_info({name})")
            ]
            Table(name, found, *columns)
    return found


_FOUND = _tables().tables
recordings = _FOUND["recordings"]
frames = _FOUND["frames"]
classes = _FOUND["classes"]
events = _FOUND["events"]
adjustments = _FOUND["adjustments"]
passes = _FOUND["passes"]
runs = _FOUND["runs"]
frame_results = _FOUND["frame_results"]
models = _FOUND["models"]
# What queries read; `ALL_LABELS` has those of removed recordings, too.
labels = _FOUND["shown_labels"]
own_labels = _FOUND["shown_rows"]
still_labels = Table("shown_stills", MetaData(), *(Column(each.name, each.type) for each in labels.c))
# What `labels` joins. Queries that count or group read one after the other: SQLite would write the union out first.
BOTH_LABELS = (own_labels, still_labels)
stills, sightings, estimates = _FOUND["stills"], _FOUND["sightings"], _FOUND["estimates"]
image_labels = _FOUND["shown_image_labels"]
view_labels = _FOUND["shown_view_labels"]
ALL_LABELS = _FOUND["labels"]

AUDITED = {
    "classes": "id",
    "attributes": "name",
    "labels": "uid",
    "stills": "uid",
    "image_labels": "frame_id",
    "view_labels": "key",
    "adjustments": "recording_id",
    "estimates": "recording_id",
    "frames": "id",
}
"""The audited tables with their keys, in the order of their references."""

# Columns that are not audited: they follow from the event, from scans, or from removed recordings.
NOT_AUDITED = {
    "image_labels": ("event_id", "hidden"),
    "view_labels": ("revision", "event_id", "hidden"),
    "adjustments": ("event_id",),
    "estimates": ("event_id",),
    "labels": ("hidden",),
    "stills": ("event_id",),
    "frames": ("recording_id", "moment_id", "key", "cloud", "pose", "position", "revision", "world", "recorded_world"),
}


@cache
def columns_of(table: str) -> tuple[str, ...]:
    """The audited columns of a table."""
    left_out = NOT_AUDITED.get(table, ())
    return tuple(column.name for column in _FOUND[table].c if column.name not in left_out)


# Queries of many modules, built once, since building a statement takes longer than running it.
MOMENT = select(frames.c.moment_id).where(frames.c.id == bindparam("frame")).scalar_subquery()
LABELS_OF_MOMENT = select(labels).where(labels.c.moment_id == MOMENT).order_by(labels.c.id)
