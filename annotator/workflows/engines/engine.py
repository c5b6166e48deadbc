"""What every engine can do, and what workers tell of themselves."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from annotator.workflows.engines.tasks import Answer, Identity, Task


@runtime_checkable
class Engine(Protocol):
    """Takes tasks, and gives their answers in any order. One thread uses it.

    Closed after use, in whatever way that came to an end; what was not answered by then is lost.

    Attributes:
        window: so many tasks keep all its workers busy. Whoever gives it no more than these before he has done with
            the answers of the oldest holds as much in memory for a long recording as for a short one.
    """

    @property
    def window(self) -> int: ...

    def start(self) -> Identity:
        """Starts the workers, if that has not been done; comes back when the first is ready.

        Raises:
            AnnotatorError: a worker cannot load the detectors, or none can be started.
        """
        ...

    def submit(self, task: Task) -> None:
        """Takes a task."""
        ...

    def wait(self, timeout_s: float) -> Answer | None:
        """The next answer; None where there is none yet after so long.

        Raises:
            WorkerError: no worker can be kept alive.
        """
        ...

    def close(self) -> None:
        """Ends all workers, at once. Nothing happens the second time."""
        ...
