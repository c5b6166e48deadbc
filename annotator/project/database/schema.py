"""The tables of the newest database version in SQLAlchemy Core; a test compares them with `migrations.py`."""

from __future__ import annotations

import zlib
from typing import Any

from sqlalchemy import Boolean, Column, Dialect, Float, ForeignKey, Integer, MetaData, Table, Text, bindparam, select
from sqlalchemy.types import TypeDecorator

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
        return value if value is None or len(value) < PACKED_FROM else zlib.compress(value.encode())

    def process_result_value(self, value: str | bytes | None, dialect: Dialect) -> str | None:
        """Converts a value from the database to Python."""
        if not isinstance(value, bytes):
            return value
        try:
            return zlib.decompress(value).decode()
        except (zlib.error, UnicodeDecodeError) as error:
            raise ProjectError(f"an event of the project is damaged ({error}); {RESTORE}") from error


METADATA = MetaData()

recordings = Table(
    "recordings",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("path", Text, nullable=False),
    Column("format", Text, nullable=False),
    Column("name", Text, nullable=False),
    Column("is_sequence", Boolean, nullable=False),
    Column("up", Text),
    Column("added_ns", Integer, nullable=False),
    Column("options", Text, nullable=False),
    Column("removed_ns", Integer),
    Column("removed_by", Text),
    Column("fingerprint", Text),
)

moves = Table(
    "moves",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("recording_id", Integer, ForeignKey("recordings.id"), nullable=False),
    Column("path_before", Text, nullable=False),
    Column("path_after", Text, nullable=False),
    Column("author", Text, nullable=False),
    Column("time_ns", Integer, nullable=False),
)

frames = Table(
    "frames",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("recording_id", Integer, ForeignKey("recordings.id"), nullable=False),
    Column("key", Text, nullable=False),
    Column("position", Integer),
    Column("revision", Integer, nullable=False),
    Column("finalised", Boolean, nullable=False),
)

events = Table(
    "events",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("frame_id", Integer, ForeignKey("frames.id")),
    Column("view_id", Text),
    Column("revision", Integer, nullable=False),
    Column("kind", Text, nullable=False),
    Column("payload", PackedText, nullable=False),
    Column("author", Text, nullable=False),
    Column("time_ns", Integer, nullable=False),
    Column("source", Text, nullable=False),
    Column("action", Text),
    Column("undoes", Text),
    Column("subject", Text),
    Column("actions", Integer),
    Column("seconds", Float),
)

labels = Table(
    "labels",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("uid", Text, nullable=False),
    Column("frame_id", Integer, ForeignKey("frames.id"), nullable=False),
    Column("label", Text, nullable=False),
    Column("box", Text, nullable=False),
    Column("score", Float),
    Column("source", Text, nullable=False),
    Column("state", Text, nullable=False),
    Column("author", Text, nullable=False),
    Column("time_ns", Integer, nullable=False),
    Column("track_id", Integer),
    Column("view_disagreement", Float),
    Column("kept_share", Float),
    Column("last_change", Float),
    Column("proposal_event_id", Integer, ForeignKey("events.id")),
    Column("event_id", Integer, ForeignKey("events.id"), nullable=False),
    Column("run_id", Integer, ForeignKey("runs.id")),
    Column("origin", Text),
    Column("image_box", Text),
    Column("image_agreement", Float),
    Column("track_linked", Boolean, nullable=False),
    Column("expected_iou_loss", Float),
    Column("suggestion", Text),
    Column("box_kind", Text, nullable=False),
    Column("attributes", Text, nullable=False),
    Column("said", Text),
)

frame_attributes = Table(
    "frame_attributes",
    METADATA,
    Column("frame_id", Integer, ForeignKey("frames.id"), primary_key=True),
    Column("attributes", Text, nullable=False),
    Column("event_id", Integer, ForeignKey("events.id"), nullable=False),
)

image_labels = Table(
    "image_labels",
    METADATA,
    Column("frame_id", Integer, ForeignKey("frames.id"), primary_key=True),
    Column("box_kind", Text, nullable=False),
    Column("boxes", Text, nullable=False),
    Column("count", Integer, nullable=False),
    Column("author", Text, nullable=False),
    Column("time_ns", Integer, nullable=False),
    Column("source", Text, nullable=False),
    Column("event_id", Integer, ForeignKey("events.id"), nullable=False),
)

view_labels = Table(
    "view_labels",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("view_id", Text, nullable=False),
    Column("frame_id", Integer, ForeignKey("frames.id")),
    Column("revision", Integer, nullable=False),
    Column("box_kind", Text, nullable=False),
    Column("boxes", Text, nullable=False),
    Column("count", Integer, nullable=False),
    Column("step", Integer),
    Column("geometry", Text),
    Column("author", Text, nullable=False),
    Column("time_ns", Integer, nullable=False),
    Column("source", Text, nullable=False),
    Column("event_id", Integer, ForeignKey("events.id"), nullable=False),
)

revertible = Table(
    "revertible",
    METADATA,
    Column("event_id", Integer, ForeignKey("events.id"), primary_key=True),
    Column("subject", Text, nullable=False),
    Column("before", Text),
    Column("after", Text),
)

adjustments = Table(
    "adjustments",
    METADATA,
    Column("recording_id", Integer, ForeignKey("recordings.id"), primary_key=True),
    Column("up", Text),
    Column("correction", Text, nullable=False),
    Column("event_id", Integer, ForeignKey("events.id"), nullable=False),
)

removed_rows = Table(
    "removed_rows",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("recording_id", Integer, ForeignKey("recordings.id"), nullable=False),
    Column("name", Text, nullable=False),
    Column("label_id", Integer),
    Column("content", Text, nullable=False),
)

runs = Table(
    "runs",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("key", Text, nullable=False),
    Column("image_detector", Text, nullable=False),
    Column("view_detector", Text, nullable=False),
    Column("config", Text, nullable=False),
    Column("started_ns", Integer, nullable=False),
    Column("finished_ns", Integer),
)

frame_results = Table(
    "frame_results",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("frame_id", Integer, ForeignKey("frames.id"), nullable=False),
    Column("key", Text, nullable=False),
    Column("run_id", Integer, ForeignKey("runs.id"), nullable=False),
    Column("status", Text, nullable=False),
    Column("reason", Text),
    Column("seconds", Float, nullable=False),
    Column("proposals", Integer, nullable=False),
    Column("time_ns", Integer, nullable=False),
)

models = Table(
    "models",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("role", Text, nullable=False),
    Column("path", Text, nullable=False),
    Column("created_ns", Integer, nullable=False),
    Column("labels", Text, nullable=False),
    Column("box_kind", Text, nullable=False),
    Column("metrics", Text, nullable=False),
    Column("manifest", Text),
    Column("fingerprint", Text, nullable=False),
    Column("active", Boolean, nullable=False),
    Column("sha256", Text, nullable=False),
)

# Queries of many modules, built once, since building a statement takes longer than running it.
LABEL_OF_UID = select(labels).where(labels.c.uid == bindparam("uid"))
LABELS_OF_FRAME = select(labels).where(labels.c.frame_id == bindparam("frame")).order_by(labels.c.id)

DERIVED = (labels, image_labels, view_labels, revertible, adjustments, frame_attributes, removed_rows)
