"""The messages between the driver and its workers, and the pool's interface of a worker."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from annotator.types.errors import AnnotatorError
from annotator.workflows.proposing.engines.tasks import Answer, Identity, Task
from annotator.workflows.proposing.sources import DetectorSource, Storage


@dataclass(frozen=True, eq=False)
class Start:
    """The driver's first message to a local worker.

    Attributes:
        source: of its detectors.
        threads: processor threads; None = all cores.
        storage: where it reads recordings.
    """

    source: DetectorSource
    threads: int | None
    storage: Storage


@dataclass(frozen=True)
class Fault:
    """Why a worker cannot start.

    Attributes:
        reason: a message, or a traceback if `is_fault`.
        is_fault: True for an error in the program, False for an error of the user.
    """

    reason: str
    is_fault: bool


def fault_of(error: Exception) -> Fault:
    """Returns the message for an error before the first task."""
    if isinstance(error, AnnotatorError):
        return Fault(str(error), False)
    return Fault("".join(traceback.format_exception(error)), True)


@dataclass(frozen=True, eq=False)
class Ready:
    """The worker has loaded its detectors."""

    worker: int
    identity: Identity


@dataclass(frozen=True, eq=False)
class Done:
    """The worker has answered a task."""

    worker: int
    answer: Answer


@dataclass(frozen=True, eq=False)
class Refused:
    """The worker cannot start, and a replacement would fail, too. The fields are those of `Fault`."""

    worker: int
    reason: str
    is_fault: bool


@dataclass(frozen=True, eq=False)
class Died:
    """The worker has ended unexpectedly."""

    worker: int
    reason: str


Event = Ready | Done | Refused | Died
Report = Callable[[Event], None]
"""Receives events, from any thread."""


@runtime_checkable
class Worker(Protocol):
    """A worker process. It sends its events to the `Report` it was made with, `Died` last."""

    def send(self, task: Task) -> None:
        """Sends a task; does nothing if the worker is dead."""
        ...

    def end(self) -> None:
        """Ends the worker at once."""
        ...
