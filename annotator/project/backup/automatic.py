"""Automatic backups: before a database is upgraded or repaired, before classes or values are merged or removed, and
after some hours of changes while a server runs.

They are files in `.backups/PROJECT` beside the project's folder, so they outlive it. Only the last few of each kind are
kept. They contain the active detectors, not all.
"""

from __future__ import annotations

import logging
import time
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path

from sqlalchemy import func, select

from annotator.project.backup.archive import read_manifest
from annotator.project.backup.content import ModelChoice
from annotator.project.backup.make import Backup, back_up
from annotator.project.config import ProjectSettings, read_config
from annotator.project.schema import events
from annotator.project.store import Store
from annotator.types.errors import AnnotatorError, ProjectError
from annotator.types.messages import first_few

LOG = logging.getLogger("annotator.project")
FOLDER = ".backups"
# Files that a message lists.
MOST_NAMED = 3
_NS_PER_HOUR = 3600 * 10**9


class Reason(StrEnum):
    """Why a backup was made automatically."""

    CHANGES = "changes"
    UPGRADE = "before-upgrade"
    REPAIR = "before-repair"
    CLASSES = "before-classes"


def automatic_backups(project: Path, reason: Reason | None = None) -> list[Path]:
    """The automatic backups of the project in a folder (for one reason), the oldest first."""
    project = project.resolve()
    return sorted((project.parent / FOLDER / project.name).glob(f"*-{reason or '*'}.zip"))


def back_up_automatically(project: Path, reason: Reason) -> Backup:
    """Makes a backup, and removes older ones of the same reason beyond the number that the settings keep.

    Raises:
        ProjectError: it cannot be made; older ones stay.
    """
    project = project.resolve()
    moment = datetime.now(UTC).strftime("%Y%m%dT%H%M%S%fZ")
    out = project.parent / FOLDER / project.name / f"{moment}-{reason.value}.zip"
    backup = back_up(project, out, ModelChoice.ACTIVE)
    if backup.missing:
        files = first_few(backup.missing, MOST_NAMED)
        LOG.warning("%s: files are missing, or no regular files, so its backup lacks them: %s", project, files)
    for old in automatic_backups(project, reason)[: -_settings(project).backups_kept]:
        old.unlink(missing_ok=True)
    return backup


def back_up_before_upgrade(project: Path) -> None:
    """As `back_up_automatically`, before the project's database is upgraded.

    Raises:
        ProjectError: it cannot be made; the message says that the database is not upgraded.
    """
    try:
        back_up_automatically(project, Reason.UPGRADE)
    except ProjectError as error:
        raise ProjectError(
            f"{project}: is not upgraded, because it cannot be backed up first: {error}; mend this, or copy the "
            "project's folder to a place where you may write"
        ) from error


class BackupClock:
    """Says when a project's next automatic backup is due: some hours after the first change since the last backup.

    It knows one open project; another one in the same folder has other events.
    """

    def __init__(self, project: Path, store: Store) -> None:
        self._project, self._store = project, store
        # the newest event of the last backup
        self._backed_up: int | None = None

    def is_due(self) -> bool:
        """Whether the project should be backed up now.

        Raises:
            ProjectError: its settings or its database cannot be read.
        """
        hours = _settings(self._project).backup_hours
        if hours is None:
            return False
        if self._backed_up is None:
            self._backed_up = _last_backed_up(self._project)
        with self._store.read() as connection:
            newest = connection.execute(select(func.coalesce(func.max(events.c.id), 0))).scalar_one()
            # a restored project has fewer events than its backups, which say nothing about it
            after = self._backed_up if self._backed_up <= newest else 0
            first = connection.execute(select(events.c.time_ns).where(events.c.id > after).limit(1)).scalar()
        return first is not None and time.time_ns() - first >= hours * _NS_PER_HOUR

    def made(self, backup: Backup) -> None:
        """Records a backup of the project."""
        self._backed_up = backup.manifest.last_event


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
