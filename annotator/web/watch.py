"""Notices what other processes do to the open projects: the command line, a job."""

from __future__ import annotations

import logging
import threading

from annotator.types.errors import AnnotatorError
from annotator.web.context import Context

LOG = logging.getLogger("annotator.web")

EVERY_S = 0.5


class Watch:
    """Looks at the end of each open project's log, as long as some page has the project open."""

    def __init__(self, context: Context, every_s: float = EVERY_S) -> None:
        self._context, self._every_s = context, every_s
        self._seen: dict[str, int] = {}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)

    def start(self) -> None:
        """Begins."""
        self._thread.start()

    def close(self) -> None:
        """Ends; waits for a look that has begun."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def look(self) -> None:
        """One look at every project that is on somebody's screen."""
        open_now = self._context.hub.projects()
        for name in self._seen.keys() - open_now:
            del self._seen[name]
        for name, project in self._context.open_projects(open_now):
            try:
                if name not in self._seen:
                    self._seen[name] = project.log.last()
                    continue
                self._seen[name], changed = project.log.news(self._seen[name])
            except AnnotatorError as error:
                LOG.warning("%s: its log cannot be read: %s", name, error)
                continue
            for news in changed:
                self._context.hub.frame_changed(name, news.frame_id, news.revision, news.author)

    def _run(self) -> None:
        while not self._ended.wait(self._every_s):
            try:
                self.look()
            except Exception:  # the next look may find better luck; without this one the server would go deaf
                LOG.exception("looking for changes failed")
