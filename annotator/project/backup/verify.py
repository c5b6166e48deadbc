"""Whether a project is sound: its database, and with `deep` also what follows from its events, and its files."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import gettempdir

from sqlalchemy import Connection

from annotator.files import sha256_of, unfinished_folder
from annotator.project.audit.events import rebuild
from annotator.project.backup.archive import is_regular, require_own_files, stored_files
from annotator.project.backup.snapshot import database_problems, reading, write_snapshot
from annotator.project.config import CONFIG_FILE, read_config
from annotator.project.database.schema import AUDITED, columns_of
from annotator.project.database.store import DATABASE_FILE, explained, open_store
from annotator.types.bases import Strict
from annotator.types.errors import ProjectError
from annotator.types.messages import first_few

Rows = dict[object, tuple[object, ...]]


class Verification(Strict):
    """The result of a verification; `problems` is empty for a sound project."""

    project: str
    deep: bool
    problems: tuple[str, ...]


def verify(project: Path, *, deep: bool = False) -> Verification:
    """Checks the project in a folder; changes nothing, and other processes may write meanwhile.

    Args:
        deep: replays all events in a copy and compares the result with the stored state; reads all files.
    """
    problems = _checked(project, deep)
    return Verification(project=project.name, deep=deep, problems=tuple(problems))


def _checked(project: Path, deep: bool) -> list[str]:
    try:
        require_own_files(project)
        if not is_regular(project, CONFIG_FILE):
            return [f"{CONFIG_FILE} is missing, or no regular file"]
        read_config(project)
        if not is_regular(project, DATABASE_FILE):
            return [f"{DATABASE_FILE} is missing, or no regular file"]
        database = project / DATABASE_FILE
        if (problems := database_problems(database)) or not deep:
            return [f"{DATABASE_FILE}: {problem}" for problem in problems]
        # what a killed verification has left there is removed
        with unfinished_folder(Path(gettempdir()), "annotator-verify") as folder:
            copy = folder / DATABASE_FILE
            write_snapshot(database, copy)
            return [*_state_problems(copy), *_file_problems(project, copy)]
    except ProjectError as error:
        return [str(error)]


def _state_problems(copy: Path) -> Iterator[str]:
    """Differences between the stored state and that which follows from the events; changes the copy."""
    store = open_store(copy)
    try:
        with store.write() as connection:
            before = _state(connection)
            rebuild(connection)
            after = _state(connection)
    except (ProjectError, sqlite3.Error) as error:
        yield f"the events contradict each other: {error}"
        return
    finally:
        store.close()
    for name, rows in after.items():
        stored = before[name]
        for what, keys in (
            ("lacks rows that the events give", [key for key in rows if key not in stored]),
            ("has rows that the events do not give", [key for key in stored if key not in rows]),
            (
                "has other values than the events give",
                [key for key in rows if key in stored and stored[key] != rows[key]],
            ),
        ):
            if keys:
                yield f"the table {name} {what}: {_named(keys)}"


def _state(connection: Connection) -> dict[str, Rows]:
    state = dict[str, Rows]()
    for table, key in AUDITED.items():
        columns = columns_of(table)
        found = connection.exec_driver_sql(f"SELECT {', '.join(columns)} FROM {table}".replace(" key,", ' "key",'))
        state[table] = {row[columns.index(key)]: tuple(row) for row in found}
    return state


def _file_problems(project: Path, copy: Path) -> Iterator[str]:
    """Files that the database refers to, and that are missing, no regular files, or have another content."""
    with explained(copy), reading(copy) as connection:
        stored = stored_files(connection)
    missing = {name for name in stored.names if not is_regular(project, name)}
    kept = {name: stored.hashes[name] for name in stored.names if name in stored.hashes and name not in missing}
    for what, names in (
        ("images of pseudo-views or detectors are missing, or no regular files", sorted(missing)),
        (
            "images of pseudo-views or detectors are damaged",
            [name for name, sha256 in kept.items() if not _has_hash(project, name, sha256)],
        ),
        ("the database refers to files outside the project", stored.outside),
    ):
        if names:
            yield f"{what}: {_named(names)}"


def _has_hash(project: Path, name: str, sha256: str) -> bool:
    try:
        return sha256_of(project / name) == sha256
    except OSError:
        return False


def _named(keys: Sequence[object]) -> str:
    return first_few(list(map(str, keys)), 3)
