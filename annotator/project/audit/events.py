"""The audit: each event is one change of a frame, with the rows that it has changed, before and after."""

from __future__ import annotations

import json
import sqlite3
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

from sqlalchemy import ColumnElement, Connection, Select, case, select
from sqlalchemy.exc import IntegrityError

from annotator.project.database.schema import AUDITED, NOT_AUDITED, AnyRow, columns_of, events, frames, packed
from annotator.project.database.store import driver_of
from annotator.project.records import parsed
from annotator.project.rows import Row
from annotator.types import Source
from annotator.types.errors import ProjectError

_BATCH = 50
# The `view_id` of changes of the classes, which belong to no frame and to no view.
CLASSES = "classes"

Key = int | str


@dataclass(frozen=True, slots=True)
class RowChange:
    """A changed row of an audited table.

    Attributes:
        table, key: as in `AUDITED`.
        before, after: of an updated row only the columns that differ; None = no row.
    """

    table: str
    key: Key
    before: Row | None
    after: Row | None

    @property
    def is_update(self) -> bool:
        """Whether the row is there before and after."""
        return self.before is not None and self.after is not None

    @property
    def is_behind(self) -> bool:
        """Whether it is a box behind the shown one of its object, which goes or comes with that."""
        return any(state is not None and state.get("behind") is not None for state in (self.before, self.after))

    def then(self, later: RowChange) -> RowChange:
        """Both changes of a row as one."""
        before = self.before if self.before is None or later.before is None else later.before | self.before
        after = later.after if self.after is None or later.after is None else self.after | later.after
        if self.after is None and before is not None and after is not None:  # removed, and there again
            return changed_row(self.table, self.key, before, after) or RowChange(self.table, self.key, {}, {})
        return RowChange(self.table, self.key, before, after)


def changed_row(table: str, key: Key, before: Row | None, after: Row | None) -> RowChange | None:
    """The change of a whole row to another; None if they are equal."""
    if before is None or after is None:
        return None if before is after else RowChange(table, key, before, after)
    columns = [name for name in after if before[name] != after[name]]
    if not columns:
        return None
    return RowChange(table, key, {name: before[name] for name in columns}, {name: after[name] for name in columns})


def as_one(changes: Iterable[RowChange]) -> list[RowChange]:
    """The changes of each row as one, in the order of their first ones, without those that come to nothing."""
    found: dict[tuple[str, Key], RowChange] = {}
    for each in changes:
        place = each.table, each.key
        found[place] = found[place].then(each) if place in found else each
    return [each for each in found.values() if each.before != each.after]


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
        kind: what was done: `kind` of a `Payload`, or a name of its own.
        author: name of the operator or program.
        time_ns: UTC nanoseconds since the epoch.
        source: manual, automatic or imported.
        rows: the changed rows.
        action: id shared by all events of one action; None for what cannot be undone.
        undoes: the action that this one reverts, or None.
        effort_target: as in `WriteContext`, if given.
        effort: of the action, on its first event, if counted.
    """

    id: int
    frame_id: int | None
    view_id: str | None
    revision: int
    kind: str
    author: str
    time_ns: int
    source: Source
    rows: tuple[RowChange, ...]
    action: str | None = None
    undoes: str | None = None
    effort_target: str | None = None
    effort: Effort | None = None


_INSERT = (
    "INSERT INTO events (frame_id, view_id, revision, kind, rows, author, time_ns, source, action, undoes, subject, "
    "actions, seconds) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"
)


def insert_event(connection: Connection, event: Event) -> Event:
    """Appends one row; returns the event with its id."""
    values = (
        event.frame_id,
        event.view_id,
        event.revision,
        event.kind,
        packed(rows_json(event.rows)),
        event.author,
        event.time_ns,
        event.source.value,
        event.action,
        event.undoes,
        event.effort_target,
        event.effort.actions if event.effort else None,
        event.effort.seconds if event.effort else None,
    )
    id = driver_of(connection).execute(_INSERT, values).lastrowid
    assert id is not None  # a row was inserted
    return replace(event, id=id)


def rows_json(rows: Sequence[RowChange]) -> str:
    """Changed rows as they are stored; a whole row without the columns that have no value."""

    def short(row: RowChange, state: Row | None) -> Row | None:
        return state if state is None or row.is_update else {name: v for name, v in state.items() if v is not None}

    listed = [(row.table, row.key, short(row, row.before), short(row, row.after)) for row in rows]
    return json.dumps(listed, ensure_ascii=False, separators=(",", ":"))


def rows_of(content: str) -> tuple[RowChange, ...]:
    """The changed rows of an event."""
    return parsed(lambda text: tuple(_changed_row(*row) for row in json.loads(text)), content)


def _changed_row(table: str, key: Key, before: Row | None, after: Row | None) -> RowChange:
    if (before is None) is not (after is None):
        columns = dict.fromkeys(columns_of(table))
        before, after = (None if state is None else columns | state for state in (before, after))
    return RowChange(table, key, before, after)


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


def in_moment_of(frame_id: int | None) -> ColumnElement[bool]:
    """Of events: they changed the moment of a frame."""
    moment = select(frames.c.moment_id).where(frames.c.id == frame_id).scalar_subquery()
    return events.c.frame_id.in_(select(frames.c.id).where(frames.c.moment_id == moment))


def without_rows(of: ColumnElement[bool]) -> list[ColumnElement[Any]]:
    """The columns of events, without the changed rows of some, of which there may be too many to read for nothing."""
    return [case((~of, each)).label("rows") if each.name == "rows" else each for each in events.c]


def event_of(row: AnyRow) -> Event:
    """The event of a table row, which may be `without_rows`."""
    return Event(
        row.id,
        row.frame_id,
        row.view_id,
        row.revision,
        row.kind,
        row.author,
        row.time_ns,
        Source(row.source),
        () if row.rows is None else rows_of(row.rows),
        row.action,
        row.undoes,
        row.subject,
        None if row.actions is None else Effort(row.actions, row.seconds),
    )


# --- the tables -------------------------------------------------------------------------------------------------------


def read_row(connection: Connection, table: str, key: Key) -> Row | None:
    """The audited columns of a row; None if there is none."""
    columns = columns_of(table)
    query = f'SELECT {_listed(columns)} FROM {table} WHERE "{AUDITED[table]}" = ?'
    found = driver_of(connection).execute(query, (key,)).fetchone()
    return None if found is None else dict(zip(columns, found, strict=True))


def apply_events(connection: Connection, made: Sequence[Event]) -> None:
    """Changes the tables as the events of one write say."""
    last = {(row.table, row.key): event for event in made for row in event.rows}
    by_table: dict[str, list[RowChange]] = defaultdict(list)
    for row in as_one(row for event in made for row in event.rows):
        by_table[row.table].append(row)
    # in the order of their references
    for table in AUDITED:
        if changes := by_table.pop(table, None):
            _apply(driver_of(connection), table, changes, last)
    if by_table:
        raise ProjectError(f"an event changes rows of {next(iter(by_table))!r}, which is no audited table")


def _apply(
    driver: sqlite3.Connection, table: str, changes: Sequence[RowChange], last: Mapping[tuple[str, Key], Event]
) -> None:
    own = NOT_AUDITED.get(table, ())
    key = AUDITED[table]
    removed = [(each.key,) for each in changes if each.after is None]
    if removed:
        driver.executemany(f'DELETE FROM {table} WHERE "{key}" = ?', removed)
    if table == "labels":
        # two labels may exchange their tracks
        moved = [(each.key,) for each in changes if each.is_update and "track_id" in (each.after or {})]
        if len(changes) > 1 and moved:
            driver.executemany("UPDATE labels SET track_id = NULL WHERE uid = ?", moved)
    # the rejected and the hidden ones first: others may get their tracks
    statements: dict[tuple[bool, tuple[str, ...]], list[tuple[Any, ...]]] = defaultdict(list)
    inserted: dict[tuple[str, ...], list[tuple[Any, ...]]] = defaultdict(list)
    for each in changes:
        if each.after is None:
            continue
        values = each.after
        if "event_id" in own:
            values = values | {"event_id": last[table, each.key].id}
        if table == "view_labels":
            values = values | {"revision": last[table, each.key].revision}
        if each.before is None:
            inserted[tuple(values)].append(tuple(values.values()))
        else:
            is_left = values.get("state") != "rejected" and values.get("behind") is None
            statements[is_left, tuple(values)].append((*values.values(), each.key))
    for (_, columns), rows in sorted(statements.items()):
        driver.executemany(_update(table, columns), rows)
    for columns, rows in inserted.items():
        driver.executemany(_insert(table, columns), rows)


@lru_cache(maxsize=256)
def _update(table: str, columns: tuple[str, ...]) -> str:
    marks = ", ".join("?" * len(columns))
    return f'UPDATE {table} SET ({_known(table, columns)}) = ({marks}) WHERE "{AUDITED[table]}" = ?'


@lru_cache(maxsize=256)
def _insert(table: str, columns: tuple[str, ...]) -> str:
    return f"INSERT INTO {table} ({_known(table, columns)}) VALUES ({', '.join('?' * len(columns))})"


def _known(table: str, columns: Sequence[str]) -> str:
    """Columns as a text of SQL; those of an event may have come with the project of somebody else."""
    if not columns or set(columns) - {*columns_of(table), "event_id", "revision"}:
        raise ProjectError(f"an event changes what are no audited columns of {table}: {', '.join(columns)}")
    return _listed(columns)


@lru_cache(maxsize=256)
def _listed(columns: tuple[str, ...]) -> str:
    return ", ".join(f'"{column}"' for column in columns)


# What applying an event raises that somebody has damaged, or that does not follow from those before it.
UNFIT = (
    *(sqlite3.IntegrityError, sqlite3.ProgrammingError, sqlite3.InterfaceError, IntegrityError),
    *(LookupError, TypeError, ValueError, ArithmeticError, AttributeError),
)


def rebuild(connection: Connection) -> int:
    """Makes the audited tables anew from all events; returns their number.

    Raises:
        ProjectError: an event is damaged, or does not follow from those before it.
    """
    for table in reversed(AUDITED):
        if table != "frames":
            connection.exec_driver_sql(f"DELETE FROM {table}")
    connection.exec_driver_sql("UPDATE frames SET finalised = 0, attributes = NULL, run_id = NULL")
    count = 0
    try:
        with without_track_index(connection):
            for event in read_events(connection):
                apply_events(connection, [event])
                count += 1
    except UNFIT as error:
        raise ProjectError(f"an event does not follow from those before it: {error}") from error
    hide_removed(connection)
    return count


@contextmanager
def without_track_index(connection: Connection) -> Iterator[None]:
    """In the block, a track may have several boxes in a moment, as between the events of one write."""
    (sql,) = connection.exec_driver_sql("SELECT sql FROM sqlite_master WHERE name = 'one_box_a_track'").one()
    connection.exec_driver_sql("DROP INDEX one_box_a_track")
    yield
    connection.exec_driver_sql(sql)


def hide_removed(connection: Connection) -> None:
    """Hides the labels and boxes of removed recordings, and only these."""
    removed = (
        "SELECT frames.id FROM frames JOIN recordings ON recordings.id = recording_id WHERE removed_ns IS NOT NULL"
    )
    for table in ("labels", "image_labels", "view_labels", "sightings"):
        is_hidden = f"ifnull(frame_id IN ({removed}), 0)"
        connection.exec_driver_sql(f"UPDATE {table} SET hidden = {is_hidden} WHERE hidden <> {is_hidden}")
