"""The engine without worker processes: `wait` runs the next task."""

from __future__ import annotations

from collections import deque

from annotator.workflows.proposing.engines.runner import TaskRunner
from annotator.workflows.proposing.tasks import Answer, DetectorSource, Identity, Storage, Task


class InlineEngine:
    """Runs tasks in this process, one at a time."""

    def __init__(self, source: DetectorSource, threads: int | None = None, storage: Storage | None = None) -> None:
        """
        Args:
            source: of the detectors.
            threads: processor threads of each detector; None = all cores.
            storage: where recordings are read.
        """
        self._source, self._threads, self._storage = source, threads, storage or Storage()
        self._runner: TaskRunner | None = None
        self._tasks: deque[Task] = deque()

    @property
    def window(self) -> int:
        return 1

    def start(self) -> Identity:
        """Loads the detectors.

        Raises:
            AnnotatorError: they cannot be loaded.
        """
        return self._ready().identity

    def submit(self, task: Task) -> None:
        """Adds a task."""
        self._tasks.append(task)

    def wait(self, timeout_s: float) -> Answer | None:
        """Runs the oldest task, regardless of `timeout_s`; returns None if there is none."""
        return self._ready().do(self._tasks.popleft()) if self._tasks else None

    def close(self) -> None:
        """Drops the detectors and all tasks."""
        self._runner = None
        self._tasks.clear()

    def _ready(self) -> TaskRunner:
        if self._runner is None:
            self._runner = TaskRunner(self._source.load(self._threads), self._storage)
        return self._runner
