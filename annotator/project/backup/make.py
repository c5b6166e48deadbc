"""Making a backup of a project, while other processes write to it."""

from __future__ import annotations

import logging
import os
import shutil
import time
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path

from sqlalchemy import func, select

from annotator import __version__
from annotator.files import sync_folder, unfinished_folder
from annotator.project.backup.archive import (
    BackupManifest,
    ModelChoice,
    Progress,
    add_file,
    add_manifest,
    keep_models,
    read_manifest,
)
from annotator.project.backup.snapshot import copied_files, reading, write_snapshot
from annotator.project.config import BACKUPS, CONFIG_FILE, ProjectSettings, read_config
from annotator.project.database.schema import events
from annotator.project.database.store import DATABASE_FILE, Store, explained
from annotator.types.errors import AnnotatorError, ProjectError
from annotator.types.messages import first_few

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
    progress: Progress = lambda done, total: None,
) -> Backup:
    """Writes the state of one moment of the project in the folder `project` to the new file `out`.

    The file appears complete or not at all. Views and finished detectors never change, so they are copied after the
    database.
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
            keep_models(database, models)
            names, missing = copied_files(project, database)
            manifest = _write(project, database, part, names, progress)
            if out.exists():
                raise ProjectError(f"{out} exists already; choose another file")
            part.replace(out)
            sync_folder(out.parent)
    except OSError as error:
        raise ProjectError(f"{out}: cannot be written: {error}") from error
    return Backup(out, manifest, missing)


def _write(
    project: Path,
    database: Path,
    part: Path,
    names: Sequence[str],
    progress: Progress,
) -> BackupManifest:
    _require_space(part.parent, database.stat().st_size + sum((project / name).stat().st_size for name in names))
    with explained(database), reading(database) as connection:
        counts = "SELECT (SELECT max(id) FROM events), (SELECT count(*) FROM labels WHERE behind IS NULL)"
        last, labels = connection.execute(counts).fetchone()
    manifest = BackupManifest(
        project=project.resolve().name,
        annotator=__version__,
        created_ns=time.time_ns(),
        last_event=last or 0,
        labels=labels,
        count=1 + len(names),
    )
    part.touch(mode=0o600, exist_ok=False)  # the database in it is for its owner only
    with part.open("wb") as target:
        with zipfile.ZipFile(target, "w", allowZip64=True) as archive:
            add_file(archive, DATABASE_FILE, database, packed=True)
            for number, name in enumerate(names, 1):
                add_file(archive, name, project / name, packed=name == CONFIG_FILE)
                progress(number, len(names))
            add_manifest(archive, manifest)
        target.flush()
        os.fsync(target.fileno())
    return manifest


def _require_space(folder: Path, needed: int) -> None:
    """Raises OSError if a backup would fill the disk, which saves of labels may need."""
    free = shutil.disk_usage(folder).free
    if free < needed + SPARE_BYTES:
        needs, has = ((size + 2**20 - 1) >> 20 for size in (needed + SPARE_BYTES, free))
        raise OSError(f"it may take {needs} MiB, with some to spare, and the disk has {has} MiB; free some space")


# --- automatic backups ------------------------------------------------------------------------------------------------
# Before a database is upgraded, and after some hours of changes while a server runs. They are files in
# `.backups/PROJECT` beside the project's folder, so they outlive it. Only the last few of each kind are kept. They
# contain the active detectors, not all.

LOG = logging.getLogger("annotator.project")
_NS_PER_HOUR = 3600 * 10**9


class Reason(StrEnum):
    """Why a backup was made automatically."""

    CHANGES = "changes"
    UPGRADE = "before-upgrade"


def automatic_backups(project: Path, reason: Reason | None = None) -> list[Path]:
    """The automatic backups of the project in a folder (for one reason), the oldest first."""
    project = project.resolve()
    return sorted((project.parent / BACKUPS / project.name).glob(f"*-{reason or '*'}.zip"))


def back_up_automatically(project: Path, reason: Reason) -> Backup:
    """Makes a backup, and removes older ones of the same reason beyond the number that the settings keep."""
    project = project.resolve()
    moment = datetime.now(UTC).strftime("%Y%m%dT%H%M%S%fZ")
    out = project.parent / BACKUPS / project.name / f"{moment}-{reason.value}.zip"
    backup = back_up(project, out, ModelChoice.ACTIVE)
    if backup.missing:
        files = first_few(backup.missing, 3)
        LOG.warning("%s: files are missing, or no regular files, so its backup lacks them: %s", project, files)
    for old in automatic_backups(project, reason)[: -_settings(project).backups_kept]:
        old.unlink(missing_ok=True)
    return backup


def back_up_before_upgrade(project: Path) -> None:
    """As `back_up_automatically`, before the project's database is upgraded."""
    try:
        back_up_automatically(project, Reason.UPGRADE)
    except ProjectError as error:
        raise ProjectError(
            f"{project}: is not upgraded, because it cannot be backed up first: {error}; mend this, or copy the "
            "project's folder to a place where you may write"
        ) from error


def is_backup_due(project: Path, store: Store) -> bool:
    """Whether some hours have passed since the first change after the last automatic backup of an open project."""
    hours = _settings(project).backup_hours
    if hours is None:
        return False
    with store.read() as connection:
        newest = connection.execute(select(func.coalesce(func.max(events.c.id), 0))).scalar_one()
        # a restored project has fewer events than its backups, which say nothing about it
        after = last if (last := _last_backed_up(project)) <= newest else 0
        # the first event has set up the classes
        first = connection.execute(select(events.c.time_ns).where(events.c.id > max(after, 1)).limit(1)).scalar()
    return first is not None and time.time_ns() - first >= hours * _NS_PER_HOUR


def _settings(project: Path) -> ProjectSettings:
    return read_config(project).settings


def _last_backed_up(project: Path) -> int:
    """The newest event in the automatic backups; 0 without any that can be read."""
    for path in reversed(automatic_backups(project)):
        try:
            return read_manifest(path).last_event
        except AnnotatorError:
            continue
    return 0
