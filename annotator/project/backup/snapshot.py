"""A copy of a database as of one moment, whether it is sound, and the hidden folder that becomes a new project."""

from __future__ import annotations

import os
import shutil
import sqlite3
import stat
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

from annotator.files import CHUNK_BYTES, sync_folder, unfinished_folder
from annotator.project.backup.archive import MODELS_FOLDER, VIEWS_FOLDER, Progress, folder_files, stored_files
from annotator.project.config import TAKEN, free_path, read_config, write_config
from annotator.project.database.migrations import schema_problems, version_problem
from annotator.project.database.store import BUSY_TIMEOUT_S, LOCKED, DatabaseFile, explained, is_lock
from annotator.types.errors import RESTORE, ProjectError


def write_snapshot(path: Path, out: Path) -> None:
    """Copies the database `path` to the new file `out` by SQLite's online backup: one file, without `-wal`.

    Neither readers nor writers of the database wait.
    """
    if not path.is_file():
        raise ProjectError(f"{path}: is missing; {RESTORE}")
    with explained(path), reading(path) as source, explained(out), closing(sqlite3.connect(out)) as target:
        # all pages in one step: SQLite begins again if another process writes between two steps
        source.backup(target, pages=-1)
    descriptor = os.open(out, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    if problems := database_problems(out):
        raise ProjectError(f"{path}: {problems[0]}; {RESTORE}, or repair it with `annotator project repair`")


def copied_files(folder: Path, database: Path) -> tuple[list[str], tuple[str, ...]]:
    """The files beside the database that a copy of the project in `folder` has, and those that are not there.

    Args:
        database: a copy of the project's, which says what it refers to.
    """
    with explained(database), reading(database) as connection:
        stored = stored_files(connection)
    found = folder_files(folder, stored)
    return found, tuple(name for name in stored.names if name not in set(found))


@contextmanager
def reading(path: Path) -> Iterator[sqlite3.Connection]:
    """A connection for one transaction that only reads, and that trusts nothing in the database's schema.

    It moves nothing from a `-wal` into the database, which may be one of another state.
    """
    address = DatabaseFile(path).address.replace("?mode=rw", "?mode=ro")
    with closing(sqlite3.connect(address, uri=True, timeout=BUSY_TIMEOUT_S, isolation_level=None)) as connection:
        connection.execute("PRAGMA trusted_schema = OFF")
        connection.execute("PRAGMA query_only = ON")
        connection.execute("PRAGMA cell_size_check = ON")
        yield connection


# Windows has neither of the last two, nor links and pipes as others have them.
_FLAGS = os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)


# --- folders that are filled under a hidden name ----------------------------------------------------------------------


@contextmanager
def new_project(root: Path, name: str) -> Iterator[Path]:
    """Yields a hidden folder for the content of a project, which becomes `root/name` if the block succeeds."""
    path = free_path(root, name)
    try:
        with unfinished_folder(root, name) as place:
            yield place
            for folder in (MODELS_FOLDER, VIEWS_FOLDER):
                (place / folder).mkdir(exist_ok=True)
            write_config(place, read_config(place).model_copy(update={"name": name}))
            # never replaces a folder with content, which another process may have made meanwhile
            place.rename(path)
            sync_folder(root)
    except OSError as error:
        # another process may have made one of this name meanwhile
        raise ProjectError(TAKEN.format(path) if path.exists() else f"{path}: cannot be created: {error}") from error


def sync_files(folder: Path) -> None:
    """Makes the new files in a folder durable: all at once, which is much faster for thousands of small files."""
    if hasattr(os, "sync"):
        os.sync()
        return
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb+") as file:
                os.fsync(file.fileno())


def copy_files(source: Path, target: Path, names: Sequence[str], progress: Progress) -> None:
    """Copies regular files of a project into the folder of a new one."""
    for number, name in enumerate(names, 1):
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        copy_regular(source / name, target / name)
        progress(number, len(names))


def copy_regular(source: Path, target: Path) -> None:
    """Copies a regular file, else raises OSError."""
    # it may have been replaced by a link or a pipe since it was listed
    with os.fdopen(os.open(source, _FLAGS), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(f"{source} is not a regular file")
        with target.open("xb") as out:
            shutil.copyfileobj(file, out, CHUNK_BYTES)


# --- checking a database ----------------------------------------------------------------------------------------------

_MOST_PROBLEMS = 20


def database_problems(path: Path) -> list[str]:
    """The problems of the database `path`, of any version; empty for a sound one.

    Nothing in the file is trusted: its schema is compared as text before any of its tables is read.
    """
    try:
        with reading(path) as connection:
            connection.execute("BEGIN")
            return list(_problems(connection))
    except sqlite3.Error as error:
        if is_lock(error):
            raise ProjectError(f"{path}: {LOCKED}") from error
        return [f"cannot be read: {error}"]


def given_id(connection: sqlite3.Connection, table: str) -> int:
    """The last id that a table has given, whether or not its row is still there; 0 if none is known."""
    try:
        row = connection.execute("SELECT seq FROM sqlite_sequence WHERE name = ?", (table,)).fetchone()
        return int(row[0]) if row is not None else 0
    except (sqlite3.Error, ValueError, TypeError):
        return 0


def _problems(connection: sqlite3.Connection) -> Iterator[str]:
    if problem := version_problem(connection):
        yield problem
        return
    differences = list(schema_problems(connection))
    yield from differences
    lines = [str(row[0]) for row in connection.execute(f"PRAGMA integrity_check({_MOST_PROBLEMS})")]
    yield from (line for line in lines if line != "ok")
    if differences or lines != ["ok"]:
        return
    orphans = connection.execute("PRAGMA foreign_key_check").fetchmany(_MOST_PROBLEMS)
    yield from (f"table {row[0]}, row {row[1]}: refers to a missing row of {row[2]}" for row in orphans)
    yield from _event_problems(connection)


def _event_problems(connection: sqlite3.Connection) -> Iterator[str]:
    """Frames that have lost events, as far as revisions tell; `verify --deep` finds the rest."""
    rows = connection.execute(
        'SELECT frames."key", frames.revision, max(events.revision) AS last FROM events '
        "JOIN frames ON frames.id = events.frame_id GROUP BY frames.id HAVING last > frames.revision"
    )
    for key, revision, last in rows.fetchmany(_MOST_PROBLEMS):
        yield f"frame {key}: is at revision {revision}, but has an event of revision {last}"
