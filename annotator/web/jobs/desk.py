"""What a piece of work has at hand: its project, its folder, and a way to say how far it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from annotator.project import Project
from annotator.types.errors import AnnotatorError
from annotator.web.jobs.messages import Measured, Progress, Said
from annotator.web.jobs.records import CurvePoint


class JobStoppedError(AnnotatorError):
    """Somebody has stopped the job."""


@dataclass(frozen=True, eq=False)
class Desk:
    """One piece of work in a worker process.

    Attributes:
        project: open.
        folder: empty at first; what is left there afterwards is the job's.
        say: tells the server.
        stopped: true once somebody wants the work to stop.
    """

    project: Project
    folder: Path
    say: Callable[[Said], None]
    stopped: Callable[[], bool]

    def progress(self, stage: str, done: float = 0.0, total: float = 0.0, eta_s: float | None = None) -> None:
        """Says how far the work is; the place where it can be stopped.

        Raises:
            JobStoppedError: somebody wants it to stop.
        """
        if self.stopped():
            raise JobStoppedError("stopped")
        self.say(Progress(stage=stage, done=done, total=total, eta_s=eta_s))

    def counted(self, stage: str) -> Callable[[int, int], None]:
        """A progress callback for a workflow."""
        return lambda done, total: self.progress(stage, float(done), float(total))

    def measured(self, point: CurvePoint) -> None:
        """Adds a point to the curves."""
        self.say(Measured(point=point))


@dataclass(frozen=True)
class Outcome:
    """What came of a piece of work: in words, and for programs."""

    message: str
    result: dict[str, Any]
