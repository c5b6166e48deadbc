"""Messages between the server and a worker process, one line of JSON each."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from annotator.web.jobs.records import CurvePoint, JobRequest

# Orders to a running worker. PAUSE and RESUME are for jobs in the background.
STOP, PAUSE, RESUME = "stop\n", "pause\n", "resume\n"


class _Message(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Order(_Message):
    """The job of a worker.

    Attributes:
        target: "module:function" of the work.
        project: the project's folder.
        folder: an empty folder for the results.
        operator: who started it.
        readable: as for `open_project`.
    """

    target: str
    project: Path
    folder: Path
    operator: str
    request: JobRequest
    readable: tuple[Path, ...] | None = None


class Progress(_Message):
    """The progress of the job."""

    type: Literal["progress"] = "progress"
    stage: str
    done: float
    total: float
    eta_s: float | None = None


class Measured(_Message):
    """A new point of the training curves."""

    type: Literal["measured"] = "measured"
    point: CurvePoint


class Finished(_Message):
    """The job is done."""

    type: Literal["finished"] = "finished"
    message: str
    result: dict[str, Any]


class Stopped(_Message):
    """The job has stopped on request."""

    type: Literal["stopped"] = "stopped"
    message: str


class Failed(_Message):
    """The job has failed; `is_fault` is True for an unexpected exception, False for an error of its input."""

    type: Literal["failed"] = "failed"
    message: str
    is_fault: bool


WorkerMessage = Progress | Measured | Finished | Stopped | Failed
WORKER_MESSAGE = TypeAdapter[WorkerMessage](Annotated[WorkerMessage, Field(discriminator="type")])
