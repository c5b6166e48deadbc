"""A worker as the pool sees it, and what it tells of itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from annotator.workflows.engines.tasks import Answer, Identity, Task


@dataclass(frozen=True, eq=False)
class Ready:
    """A worker has loaded its detectors."""

    worker: int
    identity: Identity


@dataclass(frozen=True, eq=False)
class Done:
    """A worker has done a task."""

    worker: int
    answer: Answer


@dataclass(frozen=True, eq=False)
class Refused:
    """A worker cannot begin, and neither could another one: why, and whether it is a fault of the program."""

    worker: int
    reason: str
    is_fault: bool


@dataclass(frozen=True, eq=False)
class Died:
    """A worker is gone."""

    worker: int
    reason: str


Event = Ready | Done | Refused | Died
Tell = Callable[[Event], None]
"""Takes events, from any thread."""


@runtime_checkable
class Worker(Protocol):
    """A process, as the pool sees it. It tells its events by the `Tell` that it was made with, `Died` last of all."""

    def send(self, task: Task) -> None:
        """Gives it a task; nothing happens where it has died."""
        ...

    def end(self) -> None:
        """Ends it, at once."""
        ...
