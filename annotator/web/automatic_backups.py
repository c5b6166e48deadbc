"""Makes automatic backups of the projects that this server has open, after some hours of changes."""

from __future__ import annotations

import logging
import threading

from annotator.project.backup.automatic import BackupClock, Reason, back_up_automatically
from annotator.types.errors import AnnotatorError
from annotator.web.context import Context

LOG = logging.getLogger("annotator.web")

EVERY_S = 60.0


class AutomaticBackups:
    """A thread that looks once a minute which projects are due. Nobody waits for it: a backup only reads."""

    def __init__(self, context: Context, every_s: float = EVERY_S) -> None:
        self._context, self._every_s = context, every_s
        self._clock = BackupClock()
        # projects whose backup failed, so that the log has one line each
        self._failed: set[str] = set()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="backups", daemon=True)

    def start(self) -> None:
        """Starts the thread."""
        self._thread.start()

    def close(self) -> None:
        """Ends the thread, and waits for a backup that it is making."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def make_due(self) -> None:
        """Backs up every open project that is due."""
        for name, project in self._context.all_open_projects():
            try:
                if self._clock.is_due(project.path, project.store):
                    backup = back_up_automatically(project.path, Reason.CHANGES)
                    self._clock.made(project.path, backup)
                self._failed.discard(name)
            except AnnotatorError as error:
                if name not in self._failed:
                    LOG.warning("%s: no automatic backup could be made: %s", name, error)
                self._failed.add(name)

    def _run(self) -> None:
        while not self._ended.wait(self._every_s):
            try:
                self.make_due()
            except Exception:  # must not end the thread
                LOG.exception("automatic backups failed")
