"""Removed recordings: their events stay in the log, and the present state has nothing of them.

A removed recording keeps its row, its frames (without an index) and their events. What the events give lies in the
table `removed_rows` and no longer in the derived tables, so nothing that reads these needs to know of it. When the
recording comes back, the rows return. Ids of its labels are not given to others meanwhile, so that the state is always
the one that a rebuild gives: undo refers to them.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy import ColumnElement, Connection, Table, delete, func, insert, select, update

from annotator.project.database.schema import DERIVED, events, frames, labels, recordings, removed_rows

REMOVED = select(recordings.c.id).where(recordings.c.removed_ns.is_not(None))
"""Ids of the removed recordings."""

KEPT = frames.c.recording_id.not_in(REMOVED)
"""Of frames: their recording is in the project."""

# Built once, since building a statement takes longer than running it.
_LAST_HIDDEN = select(func.max(removed_rows.c.label_id))

# Rows in one step, which bounds memory.
_BATCH = 1000


def removed_recordings(connection: Connection) -> frozenset[int]:
    """Ids of the removed recordings."""
    return frozenset(connection.execute(REMOVED).scalars())


def hide_removed(connection: Connection) -> None:
    """Moves what the events give for removed recordings out of the tables of the present state."""
    for recording_id in sorted(removed_recordings(connection)):
        for table, of_recording in _rows_of(recording_id):
            for row in connection.execute(select(table).where(of_recording)).mappings().partitions(_BATCH):
                connection.execute(insert(removed_rows), [_hidden(recording_id, table, dict(each)) for each in row])
            connection.execute(delete(table).where(of_recording))
        gone = frames.c.recording_id == recording_id
        connection.execute(update(frames).where(gone).values(position=None))


def show_again(connection: Connection, recording_id: int) -> None:
    """Moves the rows of a recording that comes back into the tables of the present state."""
    of_recording = removed_rows.c.recording_id == recording_id
    for table, _ in _rows_of(recording_id):
        query = select(removed_rows.c.content).where(of_recording, removed_rows.c.name == table.name)
        for contents in connection.execute(query.order_by(removed_rows.c.id)).scalars().partitions(_BATCH):
            connection.execute(insert(table), [_shown(table, content) for content in contents])
    connection.execute(delete(removed_rows).where(of_recording))


@contextmanager
def with_removed(connection: Connection) -> Iterator[None]:
    """In the block, the tables of the present state also have what was removed: for changes of the whole project.

    In a rebuild nothing is hidden yet, so it changes nothing there.
    """
    hidden = connection.execute(select(removed_rows.c.recording_id).distinct()).scalars().all()
    for recording_id in hidden:
        show_again(connection, recording_id)
    yield
    if hidden:
        hide_removed(connection)


def next_label_id(connection: Connection) -> int | None:
    """The id of the next label; None if the database may choose it, as nothing is hidden."""
    hidden = connection.execute(_LAST_HIDDEN).scalar()
    return None if hidden is None else max(hidden, connection.execute(select(func.max(labels.c.id))).scalar() or 0) + 1


def is_hidden(connection: Connection, label_id: int) -> bool:
    """Whether a label of a removed recording has this id."""
    return connection.execute(select(removed_rows.c.id).where(removed_rows.c.label_id == label_id)).first() is not None


def _rows_of(recording_id: int) -> Iterator[tuple[Table, ColumnElement[bool]]]:
    """Yields each other derived table, and the condition for the rows of a recording."""
    ids = select(frames.c.id).where(frames.c.recording_id == recording_id)
    for table in (each for each in DERIVED if each is not removed_rows):
        if "frame_id" in table.c:
            yield table, table.c.frame_id.in_(ids)
        elif "recording_id" in table.c:
            yield table, table.c.recording_id == recording_id
        else:
            yield table, table.c.event_id.in_(select(events.c.id).where(events.c.frame_id.in_(ids)))


def _hidden(recording_id: int, table: Table, row: dict[str, object]) -> dict[str, object]:
    label_id = row["id"] if table is labels else None
    return {"recording_id": recording_id, "name": table.name, "label_id": label_id, "content": json.dumps(row)}


def _shown(table: Table, content: str) -> dict[str, object]:
    # the ids of views have no meaning, and may be taken
    return {name: value for name, value in json.loads(content).items() if name != "id" or table is labels}
