"""Keeps what a replaced database held: the process that has it open is the last that can read it."""

from __future__ import annotations

import glob
import logging
import os
import sqlite3
import uuid
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

from annotator.files import sync_folder
from annotator.project.database.file import SHARED_MEMORY, WAL, DatabaseFile

LOG = logging.getLogger("annotator.project")

# Beside the projects: a file that appears in a folder would disturb those who remove or replace it.
FOLDER = ".replaced"


def keep_replaced(source: sqlite3.Connection, file: DatabaseFile) -> None:
    """Copies an open database whose file was removed or replaced, to `.replaced/PROJECT.until-TIME.db`.

    SQLite's files beside it that still belong to the old database are then removed, as SQLite would take them for
    those of the new one and mix both. If a copy was written over the file itself, the `-wal` is emptied: SQLite would
    move its content into the copy when the last connection is closed.
    """
    left = file.left_beside() if file.is_replaced() else []
    is_overwritten = file.is_overwritten()
    try:
        # of a file that was written over, only the pages in the `-wal` are still those of the old database
        kept = _copied(source, file.place.parent, is_overwritten)
    except (OSError, sqlite3.Error) as error:
        LOG.error("%s: was replaced, and what it held could not be kept: %s", file.path, error)
        for path in left:
            path.replace(path.with_name(f"{path.name}.of-replaced"))
        kept = None
    else:
        for path in left:
            path.unlink(missing_ok=True)
    if is_overwritten and file.lineage.has_left_wal():
        os.truncate(file.file_beside(WAL), 0)
    if kept is not None:
        LOG.warning("%s: was removed or replaced while it was open; what it held is kept in %s", file.path, kept)


def kept_copies(project: Path) -> list[Path]:
    """The copies of a project's database, the newest last."""
    return sorted((project.parent / FOLDER).glob(f"{glob.escape(project.name)}.until-*.db"))


def _copied(source: sqlite3.Connection, project: Path, is_checked: bool) -> Path | None:
    """The copy; None for a database without any event.

    Args:
        is_checked: whether to raise sqlite3.DatabaseError for a copy that is damaged.
    """
    (newest_ns,) = source.execute("SELECT max(time_ns) FROM events").fetchone()
    if newest_ns is None:
        return None
    folder = project.parent / FOLDER
    folder.mkdir(exist_ok=True)
    # named by its content, so that several processes that had it open keep one copy
    stamp = datetime.fromtimestamp(newest_ns // 10**9, UTC).strftime("%Y%m%dT%H%M%S")
    path = folder / f"{project.name}.until-{stamp}.{newest_ns % 10**9:09}.db"
    if path.exists():
        return path
    unfinished = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        # not for others, whatever the rights of the folder are
        unfinished.touch(0o600)
        with closing(sqlite3.connect(unfinished)) as target:
            source.backup(target)
            if is_checked and (found := target.execute("PRAGMA integrity_check(1)").fetchone()[0]) != "ok":
                raise sqlite3.DatabaseError(found)
        unfinished.replace(path)
        sync_folder(folder)
    finally:
        for suffix in ("", WAL, SHARED_MEMORY, "-journal"):
            unfinished.with_name(unfinished.name + suffix).unlink(missing_ok=True)
    return path
