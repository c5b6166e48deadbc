"""The append-only log: rows of the table `events` and the values they stand for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Select, insert, select

from annotator.project.payloads import PAYLOAD, Payload, ViewBoxesRemoved, ViewBoxesRestored, ViewBoxesSet
from annotator.project.schema import AnyRow, events
from annotator.types import Source

_BATCH = 50


@dataclass(frozen=True)
class Effort:
    """What something cost an operator, as the page counts it: drags, clicks and keys; and the time they took."""

    actions: int
    seconds: float


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
        action: what an operator did at once has one id; None for automatic passes and imports.
        undoes: the action that this one takes back, or None.
        subject: uid of the label, or id of the begun object, that the effort went into, where it was told.
        effort: what the action cost, on its first event, where it was counted.
    """

    id: int
    frame_id: int | None
    view_id: str | None
    revision: int
    author: str
    time_ns: int
    source: Source
    payload: Payload
    action: str | None = None
    undoes: str | None = None
    subject: str | None = None
    effort: Effort | None = None


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
    action: str | None = None,
    undoes: str | None = None,
    subject: str | None = None,
    effort: Effort | None = None,
) -> Event:
    """Append one row; `content` is the JSON of `payload`."""
    view_id = payload.view if isinstance(payload, ViewBoxesSet | ViewBoxesRestored | ViewBoxesRemoved) else None
    row = {
        "frame_id": frame_id,
        "view_id": view_id,
        "revision": revision,
        "kind": payload.kind,
        "payload": content,
        "author": author,
        "time_ns": time_ns,
        "source": source.value,
        "action": action,
        "undoes": undoes,
        "subject": subject,
        "actions": effort.actions if effort else None,
        "seconds": effort.seconds if effort else None,
    }
    key = connection.execute(insert(events), row).inserted_primary_key
    assert key is not None  # one row was inserted
    event_id = int(key[0])
    return Event(
        event_id, frame_id, view_id, revision, author, time_ns, source, payload, action, undoes, subject, effort
    )


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
        row.action,
        row.undoes,
        row.subject,
        None if row.actions is None else Effort(row.actions, row.seconds),
    )
