"""Repair: the present state is made anew from the events; of a damaged database, all that is readable is salvaged."""

from __future__ import annotations

import os
import shutil
import sqlite3
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import gettempdir
from typing import Any

from sqlalchemy import Connection, func, insert, select, update
from sqlalchemy.exc import DBAPIError

from annotator.files import open_file
from annotator.project.audit.events import (
    CLASSES,
    UNFIT,
    Event,
    RowChange,
    apply_events,
    changed_row,
    event_of,
    hide_removed,
    insert_event,
    read_row,
    rebuild,
    without_track_index,
)
from annotator.project.backup.archive import folder_files, is_content, is_regular, stored_files
from annotator.project.backup.make import Reason, automatic_backups, back_up_automatically
from annotator.project.backup.snapshot import database_problems, given_id, missing_events, reading, unfinished_folder
from annotator.project.backup.take_in import copy_regular, new_project
from annotator.project.config import ProjectConfig, ProjectSettings, new_config, read_config, write_config
from annotator.project.database.generation import has_foreign_wal, wal_of
from annotator.project.database.migrations import UNRELEASED, application_problem
from annotator.project.database.schema import AUDITED, columns_of, events, frames, unpacked
from annotator.project.database.store import DATABASE_FILE, Store, create_store, explained, open_store
from annotator.types import Source
from annotator.types.errors import RESTORE, AnnotatorError, ProjectError

AUTHOR, KIND = "annotator project repair", "repaired"
# Tables that no event changes, in the order of their references.
_PLAIN = ("recordings", "moves", "runs", "frames", "frame_results", "models", "class_changes")
_BATCH = 200
# Largest end of a truncated database that is replaced by empty pages.
MOST_FILLED = 1 << 30

Row = dict[str, Any]


@dataclass
class Repaired:
    """The result of a repair.

    Attributes:
        path: the repaired project: the same, or a new one with what was readable.
        is_new: True for a new one; the damaged project is unchanged.
        backup: of the project before its repair; None for a new one.
        events: number of events that were replayed.
        lost: number of rows that could not be read or used, by table.
        restored: number of states that were taken from the damaged project's tables, because their events are lost.
        missing: files that the project refers to, and that are not there: images of views, and files of detectors.
    """

    path: Path
    is_new: bool
    backup: Path | None = None
    events: int = 0
    lost: dict[str, int] = field(default_factory=dict)
    restored: int = 0
    missing: tuple[str, ...] = ()


def repair(project: Path, new_name: str | None = None) -> Repaired:
    """Repairs the project in a folder.

    If its database is sound, the tables of the present state are made anew from the events, after a backup. Otherwise,
    or if the events contradict each other, all that can be read goes into a new project beside it.

    Args:
        new_name: of the new project, if one is needed; default: the old name with `-repaired`.

    Raises:
        ConfigError: an invalid name.
        ProjectError: it is locked, nothing can be read, the new name is taken, or it cannot be written.
    """
    database = project / DATABASE_FILE
    if not is_regular(project, DATABASE_FILE):
        raise ProjectError(f"{database}: is missing, or no regular file; there is nothing to repair")
    is_sound = _has_config(project) and not has_foreign_wal(database) and not database_problems(database)
    # where events are missing, the tables know more than the events
    if is_sound and not _lacks_events(database):
        backup = back_up_automatically(project, Reason.REPAIR)
        with closing(open_store(database)) as store:
            try:
                with store.write() as connection:
                    return Repaired(project, False, backup.path, rebuild(connection), missing=backup.missing)
            except ProjectError:
                pass  # contradicting events: the salvage leaves them out
    return _salvage(project, new_name or f"{project.resolve().name}-repaired")


def _has_config(project: Path) -> bool:
    try:
        read_config(project)
    except ProjectError:
        return False
    return True


def _lacks_events(database: Path) -> bool:
    with reading(database) as connection:
        return missing_events(connection) > 0


def _salvage(project: Path, name: str) -> Repaired:
    root = project.resolve().parent
    with ExitStack() as stack:
        place = stack.enter_context(new_project(root, name))
        # SQLite works on a copy: opening a damaged database may write to it
        folder = stack.enter_context(unfinished_folder(Path(gettempdir()), "annotator-repair"))
        copy = folder / DATABASE_FILE
        shutil.copyfile(project / DATABASE_FILE, copy)
        _fill_up(copy)
        wal = wal_of(Path(DATABASE_FILE)).name
        if is_regular(project, wal) and not has_foreign_wal(project / DATABASE_FILE):
            shutil.copyfile(project / wal, folder / wal)
        repaired = Repaired(root / name, True)
        store = create_store(place / DATABASE_FILE)
        stack.callback(store.close)
        try:
            with reading(copy) as source:
                source.execute("SELECT count(*) FROM sqlite_master").fetchone()
                if application_problem(source.execute("PRAGMA application_id").fetchone()[0]) == UNRELEASED:
                    raise ProjectError(f"{project / DATABASE_FILE}: {UNRELEASED}")
                _copy_plain(source, store, repaired, _PLAIN)
                _replay(source, store, repaired)
                _copy_plain(source, store, repaired, ("passes",))  # which refer to events
                config = _config(project, name, source)
        except sqlite3.Error as error:
            raise ProjectError(
                f"{project / DATABASE_FILE}: nothing can be read ({error}); {_advice(project)}"
            ) from error
        if any(repaired.lost.values()):
            _restore_states(copy, store, repaired)
        write_config(place, config)
        store.close()
        repaired.missing = _copy_files(project, place)
    return repaired


def _fill_up(database: Path) -> None:
    """Appends the pages that a truncated database has lost: SQLite refuses to read a shorter file than it expects."""
    with open_file(database) as file:
        header = file.read(32)
    if len(header) < 32 or not header.startswith(b"SQLite format 3\0"):
        return
    page = int.from_bytes(header[16:18], "big")
    size = (65536 if page == 1 else page) * int.from_bytes(header[28:32], "big")
    length = database.stat().st_size
    # a damaged header may name any size; the file remains sparse
    if length < size <= length + MOST_FILLED:
        os.truncate(database, size)


def _copy_plain(source: sqlite3.Connection, store: Store, repaired: Repaired, tables: Sequence[str]) -> None:
    with store.write() as connection:
        for table in tables:
            known = {row[1] for row in connection.exec_driver_sql(f"PRAGMA table_info({table})")}
            for row in _rows(source, table, repaired):
                kept = {key: value for key, value in row.items() if key in known}
                if table == "models" and not is_content(str(row.get("path"))):  # outside the project's folder
                    _count_lost(repaired, table)
                    continue
                if table == "frames":
                    kept |= {"revision": 0, "finalised": 0, "attributes": None}
                columns = ", ".join(f'"{key}"' for key in kept)
                marks = ", ".join("?" * len(kept))
                try:
                    with connection.begin_nested():
                        connection.exec_driver_sql(
                            f"INSERT INTO {table} ({columns}) VALUES ({marks})", tuple(kept.values())
                        )
                except DBAPIError:
                    _count_lost(repaired, table)


def _replay(source: sqlite3.Connection, store: Store, repaired: Repaired) -> None:
    """Appends all events that can be read and applied; the others are left out."""
    with store.write() as connection:
        with without_track_index(connection):
            for row in _rows(source, "events", repaired):
                values: Row = {column.name: None for column in events.c} | row
                try:
                    values["rows"] = unpacked(values["rows"])
                    values["revision"] = max(values["revision"], _revision(connection, values) + 1)
                    with connection.begin_nested():
                        connection.execute(insert(events), values)
                        event = event_of(_Attributes(values))
                        _require_applicable(connection, event)
                        apply_events(connection, [event])
                        _set_revision(connection, event.frame_id, event.revision)
                except (AnnotatorError, DBAPIError, sqlite3.Error, *UNFIT):
                    _count_lost(repaired, "events")
                else:
                    repaired.events += 1
            if any(repaired.lost.values()):
                _free_tracks(connection, store)
        hide_removed(connection)
    missing = max(0, given_id(source, "events") - repaired.events - repaired.lost.get("events", 0))
    if missing:
        repaired.lost["events"] = repaired.lost.get("events", 0) + missing


def _require_applicable(connection: Connection, event: Event) -> None:
    """Refuses an event that changes rows that are not there, because earlier events are lost."""
    for row in event.rows:
        if (read_row(connection, row.table, row.key) is None) != (row.before is None):
            raise ProjectError(f"event {event.id} does not follow from those before it")


def _free_tracks(connection: Connection, store: Store) -> None:
    """Takes second boxes off their tracks, where the events that did so are lost."""
    query = (
        "WITH of_tracks AS (SELECT * FROM labels WHERE state <> 'rejected' AND behind IS NULL) "
        "SELECT uid, frame_id, track_id FROM of_tracks AS own WHERE EXISTS (SELECT 1 FROM of_tracks AS other "
        "WHERE other.moment_id = own.moment_id AND other.track_id = own.track_id AND other.id < own.id)"
    )
    for uid, frame_id, track_id in connection.exec_driver_sql(query).all():
        change = RowChange("labels", uid, {"track_id": track_id}, {"track_id": None})
        _append(connection, store, frame_id, change)


def _advice(project: Path) -> str:
    backups = automatic_backups(project)
    newest = f"; the newest automatic one is {backups[-1]}" if backups else ""
    return f"{RESTORE}{newest}"


class _Attributes:
    """A row whose columns are attributes."""

    def __init__(self, values: Row) -> None:
        self.__dict__.update(values)


def _set_revision(connection: Connection, frame_id: int | None, revision: int) -> None:
    at = frames.alias()
    moment = select(at.c.moment_id).where(at.c.id == frame_id).scalar_subquery()
    connection.execute(update(frames).where(frames.c.moment_id == moment).values(revision=revision))


def _revision(connection: Connection, values: Row) -> int:
    """The present revision of an event's frame, or of its view where it has no frame."""
    if values["frame_id"] is not None:
        query = select(frames.c.revision).where(frames.c.id == values["frame_id"])
    else:
        same = (events.c.view_id == values["view_id"]) & events.c.frame_id.is_(None)
        query = select(func.max(events.c.revision)).where(same)
    return connection.execute(query).scalar() or 0


def _restore_states(copy: Path, store: Store, repaired: Repaired) -> None:
    """Where events are lost, brings the rows to the state that the damaged database shows, if it does."""
    with reading(copy) as source, store.write() as connection:
        for table in AUDITED:
            for row in _rows(source, table, Repaired(Path(), True)):
                try:
                    with connection.begin_nested():
                        repaired.restored += _restore(connection, store, table, row)
                except (AnnotatorError, DBAPIError, sqlite3.Error, ValueError, KeyError):
                    _count_lost(repaired, "states")
        hide_removed(connection)


def _restore(connection: Connection, store: Store, table: str, row: Row) -> bool:
    """Puts one row of the damaged database in the place of the present one; False if they are equal."""
    after = {name: row[name] for name in columns_of(table)}
    key, present = after[AUDITED[table]], read_row(connection, table, after[AUDITED[table]])
    if table == "labels":  # the run that it refers to may be lost, and its id may have been given
        after |= {"run_id": None if present is None else present["run_id"]}
        after |= {"id": after["id"] if present is None else present["id"]}
    change = changed_row(table, key, present, after)
    if change is None or (table == "frames" and present is None):
        return False
    frame_id = {"frames": row.get("id"), "classes": None, "adjustments": None}.get(table, row.get("frame_id"))
    if table == "adjustments":
        query = select(func.min(frames.c.id)).where(frames.c.recording_id == key)
        frame_id = connection.execute(query).scalar_one()
    _append(connection, store, frame_id, change)
    return True


def _append(connection: Connection, store: Store, frame_id: int | None, change: RowChange) -> None:
    """Changes a row, with an event of its own."""
    view = CLASSES if frame_id is None else None
    if change.table == "view_labels":
        view = str(change.key).partition(":")[0]
    revision = _revision(connection, {"frame_id": frame_id, "view_id": view}) + 1
    event = Event(0, frame_id, view, revision, KIND, AUTHOR, store.clock(), Source.IMPORTED, (change,))
    apply_events(connection, [insert_event(connection, event)])
    _set_revision(connection, frame_id, revision)


def _config(project: Path, name: str, source: sqlite3.Connection) -> ProjectConfig:
    """The project's settings; if they cannot be read, the classes of its labels."""
    try:
        return read_config(project)
    except ProjectError:
        rows = _rows(source, "classes", Repaired(Path(), True))
        classes = tuple(sorted({str(row["name"]) for row in rows})) or ("object",)
        return new_config(name, classes, ProjectSettings(), time.time_ns())


def _copy_files(project: Path, place: Path) -> tuple[str, ...]:
    """Copies views and detectors; returns those that the project refers to, and that are not there."""
    with explained(place), reading(place / DATABASE_FILE) as connection:
        stored = stored_files(connection)
    names = list(folder_files(project, stored))
    for name in names:
        if not (place / name).exists():
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            copy_regular(project / name, place / name)
    return stored.not_in(set(names))


def _rows(source: sqlite3.Connection, table: str, repaired: Repaired) -> Iterator[Row]:
    """Yields the readable rows of a table in order; pages that cannot be read are passed over row by row."""
    try:
        if not source.execute("SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = ?", (table,)).fetchone():
            return
        last = _last_id(source, table)
    except sqlite3.Error:
        _count_lost(repaired, table)
        return
    after = -1
    while after < last:
        try:
            cursor = source.execute(
                f"SELECT rowid, * FROM {table} WHERE rowid > ? ORDER BY rowid LIMIT {_BATCH}", (after,)
            )
            found = cursor.fetchall()
            if not found:
                return
        except (sqlite3.Error, UnicodeDecodeError):
            yield from _one_by_one(source, table, after + 1, min(after + _BATCH, last), repaired)
            after = min(after + _BATCH, last)
            continue
        yield from (_row(cursor, values) for values in found)
        after = found[-1][0]


def _one_by_one(source: sqlite3.Connection, table: str, first: int, last: int, repaired: Repaired) -> Iterator[Row]:
    for number in range(first, last + 1):
        try:
            cursor = source.execute(f"SELECT rowid, * FROM {table} WHERE rowid = ?", (number,))
            if (values := cursor.fetchone()) is not None:
                yield _row(cursor, values)
        except (sqlite3.Error, UnicodeDecodeError):
            _count_lost(repaired, table)


def _row(cursor: sqlite3.Cursor, values: tuple[Any, ...]) -> Row:
    return dict(zip((column[0] for column in cursor.description[1:]), values[1:], strict=True))


def _last_id(source: sqlite3.Connection, table: str) -> int:
    """The greatest id of a table; where its end cannot be read, the last one that it has given."""
    try:
        return int(source.execute(f"SELECT coalesce(max(rowid), 0) FROM {table}").fetchone()[0])
    except sqlite3.Error:
        if given := given_id(source, table):
            return given
        raise


def _count_lost(repaired: Repaired, table: str) -> None:
    repaired.lost[table] = repaired.lost.get(table, 0) + 1
