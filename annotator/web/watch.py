"""Detects changes of the open projects by other processes: the command line, or a job."""

from __future__ import annotations

import logging
import threading

from annotator.types.errors import AnnotatorError
from annotator.web.context import Context
from annotator.web.learning import Learner

LOG = logging.getLogger("annotator.web")

EVERY_S = 0.5


class Watch:
    """Polls the log of each project that a page has open: sends an event for each changed frame and each adjusted
    recording, and lets it learn."""

    def __init__(self, context: Context, learner: Learner, every_s: float = EVERY_S) -> None:
        self._context, self._learner, self._every_s = context, learner, every_s
        self._last_events: dict[str, int] = {}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)

    def start(self) -> None:
        """Starts the thread."""
        self._thread.start()

    def close(self) -> None:
        """Ends the thread, and waits for it."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def poll(self) -> None:
        """Reads new events of every project that a page has open."""
        opened = self._context.hub.projects()
        for name in self._last_events.keys() - opened:
            del self._last_events[name]
        for name, project in self._context.open_projects(opened):
            try:
                before = self._last_events.get(name, opened[name])
                self._last_events[name], changed = project.log.changed_frames(before)
                adjusted = project.adjustments.since(before) if changed else ()
            except AnnotatorError as error:
                LOG.warning("%s: its log cannot be read: %s", name, error)
                continue
            for frame in changed:
                self._context.hub.frame_changed(name, frame.frame_id, frame.revision, frame.author)
            for recording, event, author in adjusted:
                self._context.hub.recording_adjusted(name, recording, event, author)
            try:
                self._learner.look(name, project)
            except AnnotatorError as error:
                LOG.warning("%s: a round of training cannot be started: %s", name, error)

    def _run(self) -> None:
        while not self._ended.wait(self._every_s):
            try:
                self.poll()
            except Exception:  # a failed poll must not end the thread
                LOG.exception("polling the projects' logs failed")
