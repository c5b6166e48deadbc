"""Ways to put a backup in the place of a project."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path


def replace_folder(folder: Path, backup: Path) -> None:
    # as `rm -rf`: a server may remove its own files meanwhile
    while folder.exists():
        shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(backup, folder)


def replace_database(folder: Path, backup: Path) -> None:
    """The database alone, next to what SQLite has beside the old one."""
    (folder / "project.db").unlink()
    with (
        closing(sqlite3.connect(backup / "project.db")) as source,
        closing(sqlite3.connect(folder / "new.db")) as target,
    ):
        source.backup(target)
    (folder / "new.db").rename(folder / "project.db")
