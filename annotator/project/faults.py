"""What SQLite's refusals mean to a user."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sqlalchemy.exc import DBAPIError

from annotator.types.errors import ProjectError

_PROBLEMS = {
    sqlite3.SQLITE_BUSY: "is locked by another process; close what else uses this project, or wait, and try again",
    sqlite3.SQLITE_LOCKED: "is locked by another process; close what else uses this project, or wait, and try again",
    sqlite3.SQLITE_CORRUPT: "is damaged; restore it from a backup (`sqlite3 project.db .recover` may save a part)",
    sqlite3.SQLITE_NOTADB: "is not a project database, or its beginning is damaged; restore it from a backup",
    sqlite3.SQLITE_READONLY: "cannot be written; check the permissions of the file and of its folder",
    sqlite3.SQLITE_CANTOPEN: "cannot be opened; check the permissions of the file and of its folder",
    sqlite3.SQLITE_FULL: "cannot grow, the disk is full; nothing was changed; free some space and try again",
    sqlite3.SQLITE_IOERR: "cannot be read or written, the disk reports an error; nothing was changed",
}


def problem_of(error: BaseException | None) -> str | None:
    """What to tell the user of an error of the `sqlite3` module, or None where it is a fault of our own."""
    code = getattr(error, "sqlite_errorcode", None)
    # the low byte is the primary code, the rest says more than a user can act on
    return None if code is None else _PROBLEMS.get(code & 0xFF)


@contextmanager
def told_plainly(path: Path) -> Iterator[None]:
    """Turn SQLite's errors about the file `path` into a ProjectError that says what to do.

    Raises:
        ProjectError: the database is locked, damaged, not writable or out of space.
    """
    try:
        yield
    except (DBAPIError, sqlite3.Error) as error:
        cause = error.orig if isinstance(error, DBAPIError) else error
        problem = problem_of(cause)
        if problem is None:
            raise
        raise ProjectError(f"{path}: {problem} ({cause})") from error
