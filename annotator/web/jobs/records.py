"""What can be asked for as a job, and what is known of one."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from annotator.project import Role
from annotator.types import ReviewState
from annotator.types.errors import ConfigError
from annotator.web.wire import RowId
from annotator.workflows.exporting import ExportFormat, SplitBy, parse_shares

Ids = Annotated[list[RowId], Field(min_length=1, max_length=10_000)]
Pictures = Annotated[int, Field(ge=1, le=10_000_000)]


class _Request(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class TrainRequest(_Request):
    """Train detectors; `*_pictures` is how many pictures each is shown, repeats counted (null: as the command does).

    Attributes:
        model: an ultralytics detection model such as yolo11n; null: the default.
        image_size_px, view_size_px: longer side of the pictures; null: the default.
    """

    kind: Literal["train"]
    roles: Annotated[list[Role], Field(min_length=1, max_length=2)] = Field(default_factory=lambda: list(Role))
    image_pictures: Pictures | None = None
    view_pictures: Pictures | None = None
    model: Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[a-zA-Z0-9_-]+$")] | None = None
    image_size_px: Annotated[int, Field(ge=32, le=2048, multiple_of=32)] | None = None
    view_size_px: Annotated[int, Field(ge=32, le=2048, multiple_of=32)] | None = None


class ProposeRequest(_Request):
    """Propose boxes on recordings (null: all), on at most so many frames."""

    kind: Literal["propose"]
    recordings: Ids | None = None
    limit: Annotated[int, Field(ge=1, le=10_000_000)] | None = None


class SplitRequest(_Request):
    """How the frames are divided: shares such as "train=0.8,val=0.2", and what stays in one part."""

    shares: Annotated[str, Field(max_length=400)]
    by: SplitBy = SplitBy.FRAMES
    seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = 0

    @field_validator("shares")
    @classmethod
    def _are_shares(cls, text: str) -> str:
        try:
            parse_shares(text)
        except ConfigError as error:
            raise ValueError(str(error)) from error
        return text


class ExportRequest(_Request):
    """Write a dataset to be downloaded, of the labels in these states (null: those that the format takes by itself), of
    these classes and recordings (null: all), divided or not.

    Attributes:
        pictures: what formats of 2D boxes hold.
        images: how camera images are written.
        empty_frames: also frames without any such label.
        skip_unreadable: leave out frames that cannot be read, where otherwise one of them ends the export.
    """

    kind: Literal["export"]
    format: ExportFormat = ExportFormat.RCV
    states: Annotated[list[ReviewState], Field(min_length=1, max_length=4)] | None = None
    classes: Annotated[list[Annotated[str, Field(max_length=64)]], Field(min_length=1, max_length=200)] | None = None
    recordings: Ids | None = None
    empty_frames: bool = False
    skip_unreadable: bool = False
    split: SplitRequest | None = None
    pictures: Literal["images", "views", "both"] = "images"
    images: Literal["png", "jpg"] = "png"


class ImportRequest(_Request):
    """Take over the 3D boxes that recordings bring, for every frame that has no label yet."""

    kind: Literal["import"]
    recordings: Ids


JobRequest = Annotated[TrainRequest | ProposeRequest | ExportRequest | ImportRequest, Field(discriminator="kind")]


class JobState(StrEnum):
    """How far a job is; the last three are the end."""

    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def ended(self) -> bool:
        """True for a job that nothing more will happen to."""
        return self not in (JobState.QUEUED, JobState.RUNNING)


class CurvePoint(BaseModel):
    """What was measured after one epoch of a training."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    role: Role
    epoch: int
    metrics: dict[str, float]


class Job(BaseModel):
    """One job.

    Attributes:
        project: the project's name.
        stage: what it is doing, in words.
        done, total: of the whole job, in any unit; total 0 = not known yet.
        eta_s: an estimate of the seconds left, or null.
        message: what came of it, or what went wrong.
        result: what it gives back at its end, by kind.
        created_ns: UTC nanoseconds since the epoch.
        curves: of a training, as far as it is.
        download: whether the file that an export has made can still be fetched; null where there was none.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    id: str
    project: str
    kind: Literal["train", "propose", "export", "import"]
    state: JobState = JobState.QUEUED
    stage: str = ""
    done: float = 0.0
    total: float = 0.0
    eta_s: float | None = None
    message: str | None = None
    result: dict[str, Any] | None = None
    created_ns: int
    operator: str
    curves: tuple[CurvePoint, ...] = ()
    download: Literal["kept", "gone"] | None = None
