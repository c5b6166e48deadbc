"""Repair: a new project is made of the events that can be read, and where events are lost, of the tables."""

from __future__ import annotations

import shutil
import sqlite3
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import gettempdir
from types import SimpleNamespace
from typing import Any

from sqlalchemy import Connection, func, insert, select, update
from sqlalchemy.exc import DBAPIError

from annotator.files import unfinished_folder
from annotator.project.audit.events import (
    CLASSES,
    UNFIT,
    Event,
    Key,
    apply_events,
    event_of,
    hide_removed,
    insert_event,
    read_row,
    without_track_index,
)
from annotator.project.audit.writing import Write, WriteContext
from annotator.project.backup.archive import is_content, is_regular
from annotator.project.backup.make import automatic_backups
from annotator.project.backup.snapshot import (
    copied_files,
    copy_files,
    database_problems,
    given_id,
    new_project,
    reading,
    sync_files,
    write_snapshot,
)
from annotator.project.classes.changing import KIND as CLASSES_CHANGED
from annotator.project.classes.changing import set_up_classes
from annotator.project.config import CONFIG_FILE, ProjectConfig, ProjectFile, read_config, write_config
from annotator.project.database.schema import AUDITED, columns_of, events, frames, unpacked
from annotator.project.database.store import DATABASE_FILE, Store, create_store, explained, wal_of
from annotator.project.log import next_revision
from annotator.project.rows import Terms
from annotator.types import Source
from annotator.types.errors import RESTORE, AnnotatorError, ProjectError

AUTHOR, KIND = "annotator project repair", "repaired"
# Tables that no event changes, in the order of their references.
_PLAIN = ("recordings", "runs", "frames", "frame_results", "models", "sightings")
# Columns that are as before any event.
_UNCHANGED = {"frames": {"revision": 0, "finalised": 0, "attributes": None, "run_id": None}}

Row = dict[str, Any]


@dataclass
class Repaired:
    """The result of a repair.

    Attributes:
        path: the new project; the damaged one is unchanged.
        events: number of events that were replayed.
        lost: number of rows that could not be read or used, by table.
        restored: number of states that were taken from the damaged project's tables, because their events are lost.
        missing: files that the project refers to, and that are not there: images of views, and files of detectors.
    """

    path: Path
    events: int = 0
    lost: Counter[str] = field(default_factory=Counter)
    restored: int = 0
    missing: tuple[str, ...] = ()


def repair(project: Path, new_name: str | None = None) -> Repaired:
    """Makes a new project, beside the one in a folder, of all that can be read of it.

    Its state is made anew from the events, and where events are lost, from the tables.
    """
    database = project / DATABASE_FILE
    if not is_regular(project, DATABASE_FILE):
        raise ProjectError(f"{database}: is missing, or no regular file; there is nothing to repair")
    root, name = project.resolve().parent, new_name or f"{project.resolve().name}-repaired"
    with ExitStack() as stack:
        place = stack.enter_context(new_project(root, name))
        # SQLite works on a copy: opening a damaged database may write to it
        folder = stack.enter_context(unfinished_folder(Path(gettempdir()), "annotator-repair"))
        copy = folder / DATABASE_FILE
        if database_problems(database):
            shutil.copyfile(database, copy)
            # a sound database with a `-wal` of another state is one that somebody has put there
            if is_regular(project, wal_of(database).name) and database_problems(copy):
                shutil.copyfile(wal_of(database), wal_of(copy))
        else:  # others may be writing to it
            write_snapshot(database, copy)
        repaired = Repaired(root / name)
        store = create_store(place / DATABASE_FILE)
        stack.callback(store.close)
        try:
            with _damaged(copy) as source:
                source.execute("PRAGMA user_version").fetchone()  # an error for what is no database at all
                _copy_plain(source, store, repaired.lost, _PLAIN)
                _replay(source, store, repaired)
                _copy_plain(source, store, repaired.lost, ("passes",))  # which refer to events
                try:
                    file = read_config(project)
                except ProjectError:
                    file = ProjectFile(name=name, created_ns=time.time_ns())
        except sqlite3.Error as error:
            newest = "".join(f"; the newest automatic one is {path}" for path in automatic_backups(project)[-1:])
            raise ProjectError(f"{database}: nothing can be read ({error}); {RESTORE}{newest}") from error
        if repaired.lost.total():
            _restore_states(copy, store, repaired)
        with store.write() as connection:
            if not Terms(connection).classes:
                config = ProjectConfig(**dict(file), classes=("object",))
                set_up_classes(store, connection, config, AUTHOR)
        write_config(place, file)
        store.close()
        names, repaired.missing = copied_files(project, place / DATABASE_FILE)
        copy_files(project, place, [name for name in names if name != CONFIG_FILE], lambda done, total: None)
        sync_files(place)
    return repaired


@contextmanager
def _damaged(copy: Path) -> Iterator[sqlite3.Connection]:
    """As `reading`; of a truncated database, what is left is read."""
    with reading(copy) as source:
        # else SQLite refuses a file that is shorter than its first page says
        source.execute("PRAGMA writable_schema = ON")
        yield source


def remove_labels(database: Path) -> None:
    """Replaces a copied database, which nobody has open, by one that has no labels, boxes and passes.

    Removed recordings and frames that are no longer there are left out. Ids stay.
    """
    empty = database.with_name(f"{database.name}.unlabelled")
    with explained(database), closing(create_store(empty)) as new, reading(database) as source:
        _copy_plain(source, new, Counter(), ("recordings", "frames", "models"))
        with new.write() as connection:
            # with their history: detectors that were trained before a class was renamed need it
            of_classes = "SELECT * FROM events WHERE view_id = ? AND kind = ? AND frame_id IS NULL ORDER BY id"
            cursor = source.execute(of_classes, (CLASSES, CLASSES_CHANGED))
            for values in cursor:
                row = dict(zip((column[0] for column in cursor.description), values, strict=True))
                row |= {"rows": unpacked(row["rows"]), "action": None, "undoes": None}
                made = event_of(SimpleNamespace(**row))
                apply_events(connection, [insert_event(connection, made)])
            of_present = "recording_id IN (SELECT id FROM recordings WHERE removed_ns IS NULL)"
            _keep(connection, "frames", "moment_id", f"position IS NOT NULL AND {of_present}")
            _keep(connection, "recordings", "rig_id", "removed_ns IS NULL")
            for table in ("adjustments", "estimates"):
                for row in _rows(source, table, Counter()):
                    _restore(connection, new, table, row)
    empty.replace(database)


def _keep(connection: Connection, table: str, first_of: str, kept: str) -> None:
    """Deletes the other rows of a table; of those that name the first of several, the first that is kept is named."""
    firsts = dict[int, int]()
    query = f"SELECT id, {first_of} FROM {table} WHERE {kept} ORDER BY id"
    for id, first in connection.exec_driver_sql(query).all():
        if firsts.setdefault(first, id) != first:
            connection.exec_driver_sql(f"UPDATE {table} SET {first_of} = ? WHERE id = ?", (firsts[first], id))
    connection.exec_driver_sql(f"DELETE FROM {table} WHERE NOT ({kept})")


def _copy_plain(source: sqlite3.Connection, store: Store, lost: Counter[str], tables: Sequence[str]) -> None:
    with store.write() as connection:
        for table in tables:
            known = {row[1] for row in connection.exec_driver_sql(f"PRAGMA table_info({table})")}
            rows: Iterable[Row] = _rows(source, table, lost)
            if table == "frames":
                # first those that name a moment: a scan may have found the cloud of an earlier one later
                rows = sorted(rows, key=lambda row: row.get("moment_id") != row.get("id"))
            for row in rows:
                kept = {key: value for key, value in row.items() if key in known} | _UNCHANGED.get(table, {})
                if table == "models" and not is_content(str(row.get("path"))):  # outside the project's folder
                    lost[table] += 1
                    continue
                columns = ", ".join(f'"{key}"' for key in kept)
                marks = ", ".join("?" * len(kept))
                try:
                    with connection.begin_nested():
                        connection.exec_driver_sql(
                            f"INSERT INTO {table} ({columns}) VALUES ({marks})", tuple(kept.values())
                        )
                except DBAPIError:
                    lost[table] += 1


def _replay(source: sqlite3.Connection, store: Store, repaired: Repaired) -> None:
    """Appends all events that can be read and applied; the others are left out."""
    events_moment = frames.alias()
    with store.write() as connection:
        with without_track_index(connection):
            for row in _rows(source, "events", repaired.lost):
                values: Row = {column.name: None for column in events.c} | row
                try:
                    values["rows"] = unpacked(values["rows"])
                    values["revision"] = max(values["revision"], _revision(connection, values) + 1)
                    with connection.begin_nested():
                        connection.execute(insert(events), values)
                        event = event_of(SimpleNamespace(**values))
                        _require_applicable(connection, event)
                        apply_events(connection, [event])
                        moment = select(events_moment.c.moment_id).where(events_moment.c.id == event.frame_id)
                        newer = update(frames).where(frames.c.moment_id == moment.scalar_subquery())
                        connection.execute(newer.values(revision=event.revision))
                except (AnnotatorError, DBAPIError, sqlite3.Error, *UNFIT):
                    repaired.lost["events"] += 1
                else:
                    repaired.events += 1
            if repaired.lost.total():
                _free_tracks(connection, store)
        hide_removed(connection)
    if (gone := given_id(source, "events") - repaired.events) > repaired.lost["events"]:
        repaired.lost["events"] = gone


def _require_applicable(connection: Connection, event: Event) -> None:
    """Refuses an event that changes rows that are not there, because earlier events are lost."""
    for row in event.rows:
        if (read_row(connection, row.table, row.key) is None) != (row.before is None):
            raise ProjectError(f"event {event.id} does not follow from those before it")


def _free_tracks(connection: Connection, store: Store) -> None:
    """Takes second boxes off their tracks, where the events that did so are lost."""
    query = (
        "WITH of_tracks AS (SELECT * FROM labels WHERE state <> 'rejected' AND behind IS NULL) "
        "SELECT uid, frame_id FROM of_tracks AS own WHERE EXISTS (SELECT 1 FROM of_tracks AS other "
        "WHERE other.moment_id = own.moment_id AND other.track_id = own.track_id AND other.id < own.id)"
    )
    for uid, frame_id in connection.exec_driver_sql(query).all():
        row = read_row(connection, "labels", uid)
        assert row is not None  # it was selected
        _put(connection, store, frame_id, "labels", uid, row | {"track_id": None})


def _revision(connection: Connection, values: Row) -> int:
    """The present revision of an event's frame, or of its view where it has no frame."""
    if values["frame_id"] is not None:
        query = select(frames.c.revision).where(frames.c.id == values["frame_id"])
        return connection.execute(query).scalar() or 0
    return next_revision(connection, values["view_id"]) - 1


def _restore_states(copy: Path, store: Store, repaired: Repaired) -> None:
    """Where events are lost, brings the rows to the state that the damaged database shows, if it does."""
    with _damaged(copy) as source, store.write() as connection:
        for table in AUDITED:
            for row in _rows(source, table, Counter()):
                try:
                    with connection.begin_nested():
                        repaired.restored += _restore(connection, store, table, row)
                except (AnnotatorError, DBAPIError, sqlite3.Error, ValueError, KeyError):
                    repaired.lost["states"] += 1
        hide_removed(connection)


def _restore(connection: Connection, store: Store, table: str, row: Row) -> bool:
    """Puts one row of the damaged database in the place of the present one; False if they are equal."""
    after = {name: row[name] for name in columns_of(table)}
    key = after[AUDITED[table]]
    frame_id = {"frames": row.get("id"), "classes": None}.get(table, row.get("frame_id"))
    if table in ("adjustments", "stills", "estimates"):
        of = after["rig_id"] if table == "stills" else key
        query = select(func.min(frames.c.id)).where(frames.c.recording_id == of)
        if (frame_id := connection.execute(query).scalar_one()) is None:
            return False
    present = read_row(connection, table, key)
    if table == "labels":  # the run that it refers to may be lost, and its id may have been given
        after |= {"run_id": None if present is None else present["run_id"]}
        after |= {"id": after["id"] if present is None else present["id"]}
    if present == after or (table == "frames" and present is None):
        return False
    _put(connection, store, frame_id, table, key, after)
    return True


def _put(connection: Connection, store: Store, frame_id: int | None, table: str, key: Key, after: Row) -> None:
    """Changes a row, with an event of its own."""
    view = CLASSES if frame_id is None else None
    if table == "view_labels":
        view = str(key).partition(":")[0]
    context = WriteContext(_revision(connection, {"frame_id": frame_id, "view_id": view}), AUTHOR, Source.IMPORTED)
    write = Write(store, connection, frame_id, KIND, context)
    write.put(table, key, after)
    write.event(KIND, view)
    write.finish()


def _rows(source: sqlite3.Connection, table: str, lost: Counter[str]) -> Iterator[Row]:
    """Yields the readable rows of a table in order; those on pages that cannot be read are passed over one by one."""
    try:
        if not source.execute("SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = ?", (table,)).fetchone():
            return
        last = _last_id(source, table)
    except sqlite3.Error:
        lost[table] += 1
        return
    after = -1
    while after < last:
        try:
            cursor = source.execute(f"SELECT rowid, * FROM {table} WHERE rowid > ? ORDER BY rowid LIMIT 1", (after,))
            values = cursor.fetchone()
        except (sqlite3.Error, UnicodeDecodeError):
            lost[table] += 1
            after += 1
            continue
        if values is None:
            return
        after = values[0]
        yield dict(zip((column[0] for column in cursor.description[1:]), values[1:], strict=True))


def _last_id(source: sqlite3.Connection, table: str) -> int:
    """The greatest id of a table; where its end cannot be read, the last one that it has given."""
    try:
        return int(source.execute(f"SELECT coalesce(max(rowid), 0) FROM {table}").fetchone()[0])
    except sqlite3.Error:
        if given := given_id(source, table):
            return given
        raise
