"""Keeps what a replaced database held: the process that has it open may be the last to know."""

from __future__ import annotations

import logging
import os
import sqlite3
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

from annotator.files import sync_folder
from annotator.project.database.file import SHARED_MEMORY, WAL, DatabaseFile, Identity, identity_of

LOG = logging.getLogger("annotator.project")

_PREFIX = "project.until-"


def keep_replaced(source: sqlite3.Connection, file: DatabaseFile, beside: dict[str, Identity | None]) -> None:
    """Copies an open database, whose file was replaced, to `project.until-TIME.db` in its folder.

    SQLite's files beside it that still belong to the old database are then removed, as SQLite would take them for
    those of the new one and mix both. Does nothing if the project's folder is gone as well.

    Args:
        beside: identity of each of SQLite's files beside the old database, by suffix.
    """
    if not file.place.parent.is_dir():
        return
    left = [file.beside(suffix) for suffix in (WAL, SHARED_MEMORY) if _is_left(file, suffix, beside)]
    try:
        kept = _copied(source, file.place.parent)
    except (OSError, sqlite3.Error) as error:
        LOG.error("%s: was replaced, and what it held could not be kept: %s", file.path, error)
        for path in left:
            path.replace(path.with_name(f"{path.name}.of-replaced"))
        return
    for path in left:
        path.unlink(missing_ok=True)
    if kept is not None:
        LOG.warning("%s: was removed or replaced while it was open; what it held is kept in %s", file.path, kept.name)


def kept_copies(folder: Path) -> list[Path]:
    """The copies in a project's folder, the newest last."""
    return sorted(folder.glob(f"{_PREFIX}*.db"))


def _copied(source: sqlite3.Connection, folder: Path) -> Path | None:
    """The copy; None for a database without any event."""
    (newest_ns,) = source.execute("SELECT max(time_ns) FROM events").fetchone()
    if newest_ns is None:
        return None
    # named by its content, so that several processes that had it open keep one copy
    stamp = datetime.fromtimestamp(newest_ns // 10**9, UTC).strftime("%Y%m%dT%H%M%S")
    path = folder / f"{_PREFIX}{stamp}.{newest_ns % 10**9:09}.db"
    if path.exists():
        return path
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with closing(sqlite3.connect(unfinished)) as target:
            source.backup(target)
        unfinished.replace(path)
        sync_folder(folder)
    finally:
        for suffix in ("", WAL, SHARED_MEMORY, "-journal"):
            unfinished.with_name(unfinished.name + suffix).unlink(missing_ok=True)
    return path


def _is_left(file: DatabaseFile, suffix: str, beside: dict[str, Identity | None]) -> bool:
    known = beside.get(suffix)
    return known is not None and identity_of(file.beside(suffix)) == known
