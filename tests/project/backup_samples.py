"""What a project holds, and ways to damage it."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from store_samples import state_of

from annotator.project import open_project


def content(project: Path) -> dict[str, list[tuple[object, ...]]]:
    with open_project(project) as opened:
        return state_of(opened)


def files(folder: Path) -> set[str]:
    """The files below a folder, without SQLite's temporary ones."""
    found = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()}
    return {name for name in found if not name.endswith(("-wal", "-shm"))}


def damage(statement: str) -> Callable[[Path], None]:
    def change(project: Path) -> None:
        with closing(sqlite3.connect(project / "project.db", isolation_level=None)) as connection:
            connection.execute("PRAGMA writable_schema = ON")
            for each in statement.split(";;"):
                connection.execute(each)

    return change
