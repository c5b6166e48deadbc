"""The interface of engines."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from annotator.workflows.proposing.tasks import Answer, Identity, Task


@runtime_checkable
class Engine(Protocol):
    """Takes tasks, and returns their answers in any order. Used by one thread.

    Must be closed after use, also after an exception; tasks without an answer are lost.

    Attributes:
        window: maximum number of tasks in flight; enough to keep all workers busy.
    """

    @property
    def window(self) -> int: ...

    def start(self) -> Identity:
        """Starts the workers, unless they run already. Returns when the first is ready.

        Raises:
            AnnotatorError: a worker cannot load the detectors, or none can be started.
        """
        ...

    def submit(self, task: Task) -> None:
        """Adds a task."""
        ...

    def wait(self, timeout_s: float) -> Answer | None:
        """Waits for the next answer; returns None after `timeout_s` seconds.

        Raises:
            WorkerError: the workers keep dying.
        """
        ...

    def close(self) -> None:
        """Ends all workers at once. Can be called again."""
        ...
