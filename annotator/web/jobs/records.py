"""What a job is: its request, its record and journal, the messages of its worker, and the context of its work."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import Field, ValidationError, field_validator

from annotator.detection.config import MOST_MINUTES
from annotator.files import TABLE_BYTES, link_out, private_folder, read_file, write_atomic
from annotator.project import Project
from annotator.types import BoxKind, DetectorKind, ReviewState
from annotator.types.errors import AnnotatorError, ConfigError
from annotator.web.schemas import ClassName, RowId, Schema
from annotator.workflows.exporting import ExportFormat, SplitBy, parse_shares
from annotator.workflows.importing.boxes_3d import MOST_NAME

LOG = logging.getLogger("annotator.web")

Ids = Annotated[tuple[RowId, ...], Field(min_length=1, max_length=10_000)]
Names = Annotated[dict[str, ClassName | Literal[""]], Field(max_length=1000)]
Pictures = Annotated[int, Field(ge=1, le=10_000_000)]


class TrainRequest(Schema):
    """Train detectors.

    Attributes:
        image_pictures, view_pictures: number of training images shown to each detector, repetitions counted; null: the
            default.
        minutes: how long to train the view detector; null: three minutes if it starts from a detector, else by the
            number of images.
        model: an ultralytics detection model such as yolo11n; null: the default.
        image_size_px, view_size_px: longer side of the training images; null: the default.
        background: at the lowest priority; it stops for other jobs, and begins again after them; it waits for drawing.
    """

    kind: Literal["train"]
    roles: Annotated[list[DetectorKind], Field(min_length=1, max_length=2)] = Field(
        default_factory=lambda: list(DetectorKind)
    )
    image_pictures: Pictures | None = None
    view_pictures: Pictures | None = None
    minutes: Annotated[float, Field(gt=0, le=MOST_MINUTES)] | None = None
    model: Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[a-zA-Z0-9_-]+$")] | None = None
    image_size_px: Annotated[int, Field(ge=32, le=2048, multiple_of=32)] | None = None
    view_size_px: Annotated[int, Field(ge=32, le=2048, multiple_of=32)] | None = None
    background: bool = False


class ProposeRequest(Schema):
    """Propose boxes on recordings (null: all), on at most `limit` frames."""

    kind: Literal["propose"]
    recordings: Ids | None = None
    limit: Annotated[int, Field(ge=1, le=10_000_000)] | None = None


class LiftRequest(Schema):
    """Propose 3D boxes from the 2D boxes on the images of frames that have no 3D box yet."""

    kind: Literal["lift"]


class BoxesRequest(Schema):
    """Import the boxes of a file that a page has sent.

    Attributes:
        upload: its id.
        names: the project's class of each class of the file that has another name; "" leaves its boxes out.
        recording: the recording of its images or frames; null: any.
        box_kind: what 2D boxes enclose.
        lift: then propose 3D boxes from 2D boxes.
        become: what 3D boxes become: proposals, or labels on frames without labels and proposals.
        source: name of 3D boxes as a source of proposals; null: that of the file.
        min_score: proposals with lower scores, as in the file, are left out.
        add_attributes: give the project the attributes of the file that it lacks, and labels the values that they lack.
    """

    kind: Literal["boxes"]
    upload: Annotated[str, Field(pattern="^[0-9a-f]{32}$")]
    names: Names = Field(default_factory=dict)
    recording: RowId | None = None
    box_kind: BoxKind = BoxKind.SILHOUETTE
    lift: bool = False
    become: Literal["proposals", "labels"] = "proposals"
    source: Annotated[str, Field(min_length=1, max_length=MOST_NAME)] | None = None
    min_score: Annotated[float, Field(allow_inf_nan=False)] | None = None
    add_attributes: bool = False


class SplitRequest(Schema):
    """Split of the frames: shares such as "train=0.8,val=0.2", and the unit that stays in one part."""

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


class ExportRequest(Schema):
    """Write a dataset for download.

    Attributes:
        states: of the labels; null: the format's default.
        classes, recordings: of the labels; null: all.
        empty_frames: include frames without such labels.
        skip_unreadable: leave out unreadable frames; otherwise the export fails at the first one.
        split: null: no split.
        pictures: the images in formats of 2D boxes: camera images, pseudo-views or both.
        images: file format of camera images.
    """

    kind: Literal["export"]
    format: ExportFormat = ExportFormat.RCV
    states: Annotated[tuple[ReviewState, ...], Field(min_length=1, max_length=4)] | None = None
    classes: Annotated[tuple[ClassName, ...], Field(min_length=1, max_length=200)] | None = None
    recordings: Ids | None = None
    empty_frames: bool = False
    skip_unreadable: bool = False
    split: SplitRequest | None = None
    pictures: Literal["images", "views", "both"] = "images"
    images: Literal["png", "jpg"] = "png"


class ImportRequest(Schema):
    """Import the 3D boxes that recordings contain, for every frame without labels.

    Attributes:
        names: the project's class of each class that an earlier import left out; then only these boxes are imported.
    """

    kind: Literal["import"]
    recordings: Ids
    names: Names = Field(default_factory=dict)


class CopyRequest(Schema):
    """Copy the project to a new one of that name; `labels`: with its labels, not only its recordings and detectors."""

    kind: Literal["copy"]
    name: Annotated[str, Field(max_length=64)]
    labels: bool = True


class SampleRequest(Schema):
    """Generate the sample recording, and add it to the project."""

    kind: Literal["sample"]


JobRequest = Annotated[
    TrainRequest
    | ProposeRequest
    | LiftRequest
    | BoxesRequest
    | ExportRequest
    | ImportRequest
    | CopyRequest
    | SampleRequest,
    Field(discriminator="kind"),
]


def in_background(request: JobRequest) -> bool:
    """Whether a job steps aside for other jobs and for drawing."""
    return isinstance(request, TrainRequest) and request.background


def expected_s(request: JobRequest) -> float | None:
    """How long a job takes before its progress shows it, seconds: the minutes of a training, for each detector."""
    return request.minutes * 60 * len(request.roles) if isinstance(request, TrainRequest) and request.minutes else None


JobKind = Literal["train", "propose", "lift", "boxes", "export", "import", "copy", "sample"]
# Those that keep the processor busy run one after the other. So do the others, which never wait for the first ones.
HEAVY: tuple[JobKind, ...] = ("train", "propose", "lift")
# Kind of job -> "module:function" of the work, which takes a `JobContext` and the request. A string, so that the server
# does not import the work.
WORK: dict[str, str] = {kind: f"annotator.web.jobs.work:{kind}_work" for kind in get_args(JobKind)}


class JobState(StrEnum):
    """State of a job; the last three are final."""

    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def ended(self) -> bool:
        return self not in (JobState.QUEUED, JobState.RUNNING)


class CurvePoint(Schema):
    """The metrics of a training after one epoch."""

    role: DetectorKind
    epoch: int
    metrics: dict[str, float]


class Job(Schema):
    """One job.

    Attributes:
        project: the project's name.
        stage: description of the present step.
        done, total: progress of the whole job, in any unit; total 0 = unknown.
        eta_s: estimated remaining seconds, or null.
        message: the outcome or the error, for people.
        result: the outcome for programs; depends on the kind.
        created_ns: UTC nanoseconds since the epoch.
        curves: of a training, up to now.
        download: whether an export's file is still available; null for a job without a file.
        heavy: whether it is in the lane of jobs that keep the processor busy.
        background: whether it steps aside for other jobs and for drawing.
    """

    id: Annotated[str, Field(pattern="^[0-9a-f]{32}$")]
    project: str
    kind: JobKind
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
    heavy: bool = False
    background: bool = False


FILE = "journal.json"
SERVER_STOPPED = "the server was stopped"


class _Journal(Schema):
    jobs: tuple[Job, ...]


def require_own_files(folder: Path) -> None:
    """Refuses a folder of jobs with links that lead out of it: somebody may have sent it, together with projects."""
    try:
        link = folder if folder.is_symlink() else link_out(folder) if folder.exists() else None
    except OSError as error:
        raise ConfigError(f"{error.filename}: cannot be read: {error.strerror}") from error
    if link is not None:
        raise ConfigError(f"{link}: is a link that leads out of the projects' folder of jobs; remove it")


def read_journal(folder: Path) -> list[Job]:
    """The jobs in the journal, oldest first; unfinished ones become failed. Empty if it is missing or unreadable."""
    path = folder / FILE
    try:
        jobs = _Journal.model_validate_json(read_file(path, TABLE_BYTES)).jobs
    except FileNotFoundError:
        return []
    except (OSError, ValidationError) as error:
        # the server can start without the list of earlier jobs
        LOG.warning("%s: cannot be read, earlier jobs are not listed: %s", path, error)
        return []
    return [_ended(job) for job in jobs]


def write_journal(folder: Path, jobs: Iterable[Job]) -> None:
    """Writes the journal; an error is logged only."""
    try:
        private_folder(folder)
        write_atomic(folder / FILE, _Journal(jobs=tuple(jobs)).model_dump_json().encode(), private=True)
    except OSError as error:
        LOG.warning("%s: the list of jobs cannot be written: %s", folder, error)


def _ended(job: Job) -> Job:
    if job.state.ended:
        return job
    return job.model_copy(update={"state": JobState.FAILED, "message": SERVER_STOPPED, "eta_s": None})


# Orders to a running worker; PAUSE is for jobs in the background.
STOP, PAUSE = "stop", "pause"


class Order(Schema):
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


class Progress(Schema):
    """The progress of the job."""

    stage: str
    done: float
    total: float


class Measured(Schema):
    """A new point of the training curves."""

    point: CurvePoint


class Ended(Schema):
    """The end of the job. `is_fault`: it is an unexpected exception, whose message is for the log only."""

    state: Literal[JobState.DONE, JobState.CANCELLED, JobState.FAILED]
    message: str
    result: dict[str, Any] | None = None
    is_fault: bool = False


WorkerMessage = Progress | Measured | Ended


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

    def progress(self, stage: str, done: float = 0.0, total: float = 0.0) -> None:
        """Reports the progress. A job stops at its next call of this method."""
        if self.stopped():
            raise JobStoppedError("stopped")
        self.send(Progress(stage=stage, done=done, total=total))

    def counter(self, stage: str) -> Callable[[int, int], None]:
        """A progress callback (done, total) for a workflow."""
        return lambda done, total: self.progress(stage, float(done), float(total))

    def measured(self, point: CurvePoint) -> None:
        self.send(Measured(point=point))


@dataclass(frozen=True)
class Outcome:
    """The outcome of a job: a message for people, and a result for programs."""

    message: str
    result: dict[str, Any]
