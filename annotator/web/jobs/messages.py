"""What the server and a worker say to each other: one line of JSON each."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from annotator.web.jobs.records import CurvePoint, JobRequest

STOP = "stop\n"


class _Message(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Order(_Message):
    """What a worker is to do.

    Attributes:
        target: "module:function" of the work.
        project: the project's folder.
        folder: an empty folder for what the work makes.
    """

    target: str
    project: Path
    folder: Path
    request: JobRequest


class Progress(_Message):
    """How far the work is."""

    type: Literal["progress"] = "progress"
    stage: str
    done: float
    total: float
    eta_s: float | None = None


class Measured(_Message):
    """A new point of the curves."""

    type: Literal["measured"] = "measured"
    point: CurvePoint


class Finished(_Message):
    """The work is done."""

    type: Literal["finished"] = "finished"
    message: str
    result: dict[str, Any]


class Stopped(_Message):
    """The work has stopped because it was asked to."""

    type: Literal["stopped"] = "stopped"
    message: str


class Failed(_Message):
    """The work cannot go on; `is_fault` where the program is to blame and not its input."""

    type: Literal["failed"] = "failed"
    message: str
    is_fault: bool


Said = Progress | Measured | Finished | Stopped | Failed
SAID = TypeAdapter[Said](Annotated[Said, Field(discriminator="type")])
