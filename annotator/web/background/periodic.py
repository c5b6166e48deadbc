"""A thread that does the same again and again while a server runs."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

LOG = logging.getLogger("annotator.web")


class Periodic:
    """A thread that calls a function at fixed intervals, the first time after one."""

    def __init__(self, name: str, every_s: float, call: Callable[[], object]) -> None:
        self._name, self._every_s, self._call = name, every_s, call
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Starts the thread."""
        self._thread.start()

    def close(self) -> None:
        """Ends the thread, and waits for a call that it is making."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(self._every_s):
            try:
                self._call()
            except Exception:  # a failed call must not end the thread
                LOG.exception("%s: failed, and is tried again in %g s", self._name, self._every_s)
