"""Detects changes of the open projects by other processes: the command line, or a job."""

from __future__ import annotations

import logging
from weakref import WeakKeyDictionary

from annotator.project import Project
from annotator.project.database.store import waiting_at_most
from annotator.types.errors import AnnotatorError
from annotator.web.background.learning import Learner
from annotator.web.background.periodic import Periodic
from annotator.web.context import Context

LOG = logging.getLogger("annotator.web")

EVERY_S = 0.5
# For a locked project: the other projects wait meanwhile.
WAIT_S = 0.1


class Watch(Periodic):
    """Polls the log of each project that a page has open: sends an event for each changed frame, each adjusted
    recording, each change of the classes and each added or removed recording, and lets it learn."""

    def __init__(self, context: Context, learner: Learner) -> None:
        super().__init__("watch", EVERY_S, self.poll)
        self._context, self._learner = context, learner
        self._last_events = WeakKeyDictionary[Project, int]()
        self._problems: dict[str, str] = {}

    def poll(self) -> None:
        """Reads new events of every project that a page has open."""
        opened = self._context.hub.projects()
        for project in [each for each in self._last_events if each.path.name not in opened]:
            del self._last_events[project]
        for name in filter(self._context.is_open, opened):
            try:
                with waiting_at_most(WAIT_S):
                    self._poll(name, opened[name])
            except AnnotatorError as error:
                self._failed(name, str(error))
            else:
                self._problems.pop(name, None)

    def _poll(self, name: str, since: int) -> None:
        project = self._context.project(name)
        before = self._last_events.get(project, since)
        newest, changed = project.log.changed_frames(before)
        adjusted = project.adjustments.since(before) if changed else ()
        classes = project.class_changes_after(before) if newest > before else ()
        self._last_events[project] = newest
        for frame in changed:
            self._context.hub.frame_changed(project, frame.frame_id, frame.revision, frame.author)
        for recording, event, author in adjusted:
            self._context.hub.recording_adjusted(project, recording, event, author)
        self._context.hub.recordings_are(project, project.recordings.removed_by())
        for author, change in classes:
            self._context.hub.classes_changed(name, change.classes, author)
        self._learner.look(name, project)

    def _failed(self, name: str, problem: str) -> None:
        """Logs a problem once, not twice a second."""
        if self._problems.get(name) != problem:
            LOG.warning("%s: it cannot be watched, or cannot learn: %s", name, problem)
        self._problems[name] = problem
