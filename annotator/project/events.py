"""The append-only log: rows of the table `events` and the values they stand for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Select, insert, select

from annotator.project.payloads import PAYLOAD, Payload, ViewBoxesSet
from annotator.project.schema import AnyRow, events
from annotator.types import Source

_BATCH = 50


@dataclass(frozen=True)
class Event:
    """One thing that was said about a frame, or about a pseudo-view that came from none.

    Attributes:
        id: grows with every event of the project.
        frame_id: the frame, or None.
        view_id: the pseudo-view, for boxes on one.
        revision: of the frame (or of the view, where there is no frame) after the event.
        author: a person's name, or a program's.
        time_ns: UTC nanoseconds since the epoch.
        source: how it came about.
        payload: what was said.
    """

    id: int
    frame_id: int | None
    view_id: str | None
    revision: int
    author: str
    time_ns: int
    source: Source
    payload: Payload


def insert_event(
    connection: Connection,
    *,
    frame_id: int | None,
    revision: int,
    content: str,
    payload: Payload,
    author: str,
    time_ns: int,
    source: Source,
) -> Event:
    """Append one row; `content` is the JSON of `payload`."""
    view_id = payload.view if isinstance(payload, ViewBoxesSet) else None
    row = {
        "frame_id": frame_id,
        "view_id": view_id,
        "revision": revision,
        "kind": payload.kind,
        "payload": content,
        "author": author,
        "time_ns": time_ns,
        "source": source.value,
    }
    key = connection.execute(insert(events), row).inserted_primary_key
    assert key is not None  # one row was inserted
    return Event(int(key[0]), frame_id, view_id, revision, author, time_ns, source, payload)


def read_events(connection: Connection, query: Select[Any] | None = None, after: int = 0) -> Iterator[Event]:
    """Events in order, a few at a time, so that a long log needs little memory.

    Args:
        query: a selection from the table `events`; all of them by default.
        after: the id of the last event that is not wanted.
    """
    chosen = select(events) if query is None else query
    while True:
        rows = connection.execute(chosen.where(events.c.id > after).order_by(events.c.id).limit(_BATCH)).all()
        for row in rows:
            yield event_of(row)
        if len(rows) < _BATCH:
            return
        after = rows[-1].id


def event_of(row: AnyRow) -> Event:
    """The event that a row of the table holds."""
    return Event(
        row.id,
        row.frame_id,
        row.view_id,
        row.revision,
        row.author,
        row.time_ns,
        Source(row.source),
        PAYLOAD.validate_json(row.payload),
    )
