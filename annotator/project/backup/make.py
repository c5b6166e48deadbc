"""Making a backup of a project, while other processes write to it."""

from __future__ import annotations

import os
import shutil
import sqlite3
import time
import zipfile
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from annotator import __version__
from annotator.files import sync_folder
from annotator.project.backup.archive import (
    BackupManifest,
    ModelChoice,
    Progress,
    add_file,
    add_manifest,
    folder_files,
    keep_models,
    stored_files,
)
from annotator.project.backup.snapshot import database_problems, reading, unfinished_folder, write_snapshot
from annotator.project.config import CONFIG_FILE, read_config
from annotator.project.database.store import DATABASE_FILE, Clock, explained
from annotator.types.errors import RESTORE, ProjectError

# What a backup leaves free on the disk, bytes.
SPARE_BYTES = 2**25


@dataclass(frozen=True)
class Backup:
    """A written backup: the file, what it contains, and files of the project that it lacks, as they are missing."""

    path: Path
    manifest: BackupManifest
    missing: tuple[str, ...]


def back_up(
    project: Path,
    out: Path,
    models: ModelChoice = ModelChoice.ALL,
    *,
    clock: Clock = time.time_ns,
    progress: Progress = lambda done, total: None,
) -> Backup:
    """Writes the state of one moment of the project in the folder `project` to the new file `out`.

    The file appears complete or not at all. Views and finished detectors never change, so they are copied after the
    database.

    Args:
        models: the detectors to include.

    Raises:
        ProjectError: no project, a damaged or locked one; `out` exists already, or cannot be written.
    """
    read_config(project)
    out = out.resolve()
    if out.exists():
        raise ProjectError(f"{out} exists already; choose another file")
    try:
        # by the project's name, since that of a backup contains the moment: the next one finds what a killed one left
        with unfinished_folder(out.parent, f"{project.resolve().name}-backup") as place:
            database, part = place / DATABASE_FILE, place / "backup.zip"
            if (project / DATABASE_FILE).is_file():  # else `write_snapshot` says what to do
                # the copy of the database, and the same in the archive
                _require_space(place, 2 * (project / DATABASE_FILE).stat().st_size)
            write_snapshot(project / DATABASE_FILE, database)
            if problems := database_problems(database):
                raise ProjectError(
                    f"{project / DATABASE_FILE}: {problems[0]}; a damaged project is not backed up; {RESTORE}, "
                    "or repair it with `annotator project repair`"
                )
            with explained(database):
                keep_models(database, models)
            manifest, missing = _write(project, database, part, models, clock(), progress)
            if out.exists():
                raise ProjectError(f"{out} exists already; choose another file")
            part.replace(out)
            sync_folder(out.parent)
    except OSError as error:
        raise ProjectError(f"{out}: cannot be written: {error}") from error
    return Backup(out, manifest, missing)


def _write(
    project: Path, database: Path, part: Path, models: ModelChoice, created_ns: int, progress: Progress
) -> tuple[BackupManifest, tuple[str, ...]]:
    with explained(database), reading(database) as connection:
        stored = stored_files(connection)
        version, events, last, labels = _counts(connection)
    names = list(folder_files(project, stored))
    files = []
    _require_space(part.parent, database.stat().st_size + sum((project / name).stat().st_size for name in names))
    part.touch(mode=0o600, exist_ok=False)  # the database in it is for its owner only
    with part.open("wb") as target:
        with zipfile.ZipFile(target, "w", allowZip64=True) as archive:
            files.append(add_file(archive, DATABASE_FILE, database, packed=True))
            for number, name in enumerate(names, 1):
                files.append(add_file(archive, name, project / name, packed=name == CONFIG_FILE))
                progress(number, len(names))
            manifest = BackupManifest(
                project=project.resolve().name,
                annotator=__version__,
                created_ns=created_ns,
                database_version=version,
                last_event=last,
                events=events,
                labels=labels,
                models=models,
                files=tuple(files),
            )
            add_manifest(archive, manifest)
        target.flush()
        os.fsync(target.fileno())
    return manifest, stored.not_in(set(names))


def _require_space(folder: Path, needed: int) -> None:
    """Raises OSError if a backup would fill the disk, which saves of labels may need."""
    free = shutil.disk_usage(folder).free
    if free < needed + SPARE_BYTES:
        needs, has = ((size + 2**20 - 1) >> 20 for size in (needed + SPARE_BYTES, free))
        raise OSError(f"it may take {needs} MiB, with some to spare, and the disk has {has} MiB; free some space")


def _counts(connection: sqlite3.Connection) -> tuple[int, int, int, int]:
    """Version of the database, number of events, id of the newest one, and number of labels."""
    with closing(connection.cursor()) as cursor:
        return (
            cursor.execute("PRAGMA user_version").fetchone()[0],
            *cursor.execute("SELECT count(*), coalesce(max(id), 0) FROM events").fetchone(),
            cursor.execute("SELECT count(*) FROM labels").fetchone()[0],
        )
