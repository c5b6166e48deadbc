"""Makes automatic backups of the projects that this server has open, after some hours of changes."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from weakref import WeakKeyDictionary

from annotator.project import Project
from annotator.project.backup.make import BackupClock, Reason, back_up_automatically
from annotator.types.errors import AnnotatorError
from annotator.web.background.periodic import Periodic
from annotator.web.context import Context

LOG = logging.getLogger("annotator.web")

EVERY_S = 60.0
# A failed backup is tried again after this time, for it may have copied much before it failed.
PAUSE_S = 3600.0


class AutomaticBackups(Periodic):
    """Looks once a minute which projects are due. Nobody waits for it: a backup only reads."""

    def __init__(self, context: Context, seconds: Callable[[], float] = time.monotonic) -> None:
        """
        Args:
            seconds: a clock.
        """
        super().__init__("automatic backups", EVERY_S, self.make_due)
        self._context, self._seconds = context, seconds
        self._clocks = WeakKeyDictionary[Project, BackupClock]()
        # when to try again, by project whose last backup failed
        self._paused = WeakKeyDictionary[Project, float]()

    def make_due(self) -> None:
        """Backs up every open project that is due."""
        for name, project in self._context.all_open_projects():
            if self._seconds() < self._paused.get(project, 0.0):
                continue
            clock = self._clocks.setdefault(project, BackupClock(project.path, project.store))
            try:
                if clock.is_due():
                    clock.made(back_up_automatically(project.path, Reason.CHANGES))
                self._paused.pop(project, None)
            except AnnotatorError as error:
                LOG.warning("%s: no automatic backup could be made; the next try is in an hour: %s", name, error)
                self._paused[project] = self._seconds() + PAUSE_S
