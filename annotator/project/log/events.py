"""Events, and the rows of the append-only table `events`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import Connection, Select, insert, select

from annotator.project.database.schema import AnyRow, events
from annotator.project.log.event_types import (
    PAYLOAD,
    ClassesChanged,
    Payload,
    ViewBoxesRemoved,
    ViewBoxesRestored,
    ViewBoxesSet,
)
from annotator.project.log.records import parsed
from annotator.types import Source

_BATCH = 50
# The `view_id` of changes of the classes, which belong to no frame and to no view.
CLASSES = "classes"


@dataclass(frozen=True)
class Effort:
    """Effort of an operator as counted by the page: number of drags, clicks and keys, and their duration in seconds."""

    actions: int
    seconds: float


@dataclass(frozen=True)
class Event:
    """One change of a frame, of a pseudo-view that belongs to no frame, or of the classes.

    Attributes:
        id: increases with every event of the project; 0 until it is stored.
        frame_id: the frame, or None.
        view_id: the pseudo-view, for boxes on one; `CLASSES` for a change of the classes.
        revision: of the frame (or of the view, where there is no frame) after the event.
        author: name of the operator or program.
        time_ns: UTC nanoseconds since the epoch.
        source: manual, automatic or imported.
        payload: the change.
        action: id shared by all events of one operator action; None for automatic passes and imports.
        undoes: the action that this one reverts, or None.
        effort_target: uid of the label, or id of the draft, that the effort was for, if given.
        effort: of the action, on its first event, if counted.
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
    effort_target: str | None = None
    effort: Effort | None = None


# Built once, since building a statement takes longer than running it.
_INSERT = insert(events)


def insert_event(connection: Connection, event: Event, content: str) -> Event:
    """Appends one row; returns the event with its id and its view. `content` is the JSON of its payload."""
    payload, view_id = event.payload, None
    if isinstance(payload, ClassesChanged):
        view_id = CLASSES
    elif isinstance(payload, ViewBoxesSet | ViewBoxesRestored | ViewBoxesRemoved):
        view_id = payload.view
    row = {
        "frame_id": event.frame_id,
        "view_id": view_id,
        "revision": event.revision,
        "kind": payload.kind,
        "payload": content,
        "author": event.author,
        "time_ns": event.time_ns,
        "source": event.source.value,
        "action": event.action,
        "undoes": event.undoes,
        "subject": event.effort_target,
        "actions": event.effort.actions if event.effort else None,
        "seconds": event.effort.seconds if event.effort else None,
    }
    key = connection.execute(_INSERT, row).inserted_primary_key
    assert key is not None  # one row was inserted
    return replace(event, id=int(key[0]), view_id=view_id)


def read_events(connection: Connection, query: Select[Any] | None = None, after: int = 0) -> Iterator[Event]:
    """Yields events in order, read in batches, so that a long log needs little memory.

    Args:
        query: a selection from the table `events`; all events by default.
        after: only events with a greater id.
    """
    selected = select(events) if query is None else query
    while True:
        rows = connection.execute(selected.where(events.c.id > after).order_by(events.c.id).limit(_BATCH)).all()
        for row in rows:
            yield event_of(row)
        if len(rows) < _BATCH:
            return
        after = rows[-1].id


def event_of(row: AnyRow) -> Event:
    """The event of a table row."""
    return Event(
        row.id,
        row.frame_id,
        row.view_id,
        row.revision,
        row.author,
        row.time_ns,
        Source(row.source),
        parsed(PAYLOAD.validate_json, row.payload),
        row.action,
        row.undoes,
        row.subject,
        None if row.actions is None else Effort(row.actions, row.seconds),
    )
