"""The context of a job's work in a worker process: its project, its folder and its progress."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from annotator.project import Project
from annotator.types.errors import AnnotatorError
from annotator.web.jobs.messages import Measured, Progress, WorkerMessage
from annotator.web.jobs.records import CurvePoint


class JobStoppedError(AnnotatorError):
    """The job was stopped by an operator."""


@dataclass(frozen=True, eq=False)
class JobContext:
    """The context of one job.

    Attributes:
        project: open.
        folder: for the job's results; initially empty.
        operator: who started the job.
        send: sends a message to the server.
        stopped: returns True once a stop is requested.
    """

    project: Project
    folder: Path
    operator: str
    send: Callable[[WorkerMessage], None]
    stopped: Callable[[], bool]

    def progress(self, stage: str, done: float = 0.0, total: float = 0.0, eta_s: float | None = None) -> None:
        """Reports the progress. A job stops at its next call of this method.

        Raises:
            JobStoppedError: a stop was requested.
        """
        if self.stopped():
            raise JobStoppedError("stopped")
        self.send(Progress(stage=stage, done=done, total=total, eta_s=eta_s))

    def counter(self, stage: str) -> Callable[[int, int], None]:
        """A progress callback (done, total) for a workflow."""
        return lambda done, total: self.progress(stage, float(done), float(total))

    def measured(self, point: CurvePoint) -> None:
        """Adds a point to the training curves."""
        self.send(Measured(point=point))


@dataclass(frozen=True)
class Outcome:
    """The outcome of a job: a message for people, and a result for programs."""

    message: str
    result: dict[str, Any]
