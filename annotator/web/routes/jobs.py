"""Jobs: start, list and stop; export formats, and downloads of exports."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Body, Path, Query
from fastapi.responses import FileResponse
from pydantic import BaseModel, Field

from annotator.detection.config import MOST_MINUTES
from annotator.detection.pretrained import has_base
from annotator.project import Project, StoredModel
from annotator.project.config import free_path
from annotator.types import BoxKind, DetectorKind, ReviewState
from annotator.types.errors import NotFoundError
from annotator.web.context import AtProject, Ctx, InProject, Operator
from annotator.web.jobs.records import CopyRequest, CurvePoint, Job, JobRequest
from annotator.web.routes.projects import ModelInfo, model_info
from annotator.web.schemas import RowId, Schema
from annotator.web.uploads import Upload, add_upload, find_upload, remove_upload
from annotator.workflows.exporting import WRITERS, ExportFormat
from annotator.workflows.importing import BoxFormat, FlatFormat, preview_boxes
from annotator.workflows.training.held_out import Decision
from annotator.workflows.training.model_report import model_facts

router = APIRouter(tags=["jobs"])

# of a job, or of a file that was sent
RandomId = Annotated[str, Path(pattern="^[0-9a-f]{32}$")]


class FormatInfo(BaseModel):
    """An export format.

    Attributes:
        summary: a short description, for people.
        states: the review states exported by default.
        flat: True for a format of 2D boxes on images.
    """

    name: ExportFormat
    summary: str
    states: list[ReviewState]
    flat: bool


@router.post("/api/projects/{name}/jobs", status_code=201)
def begin(at: AtProject, body: Annotated[JobRequest, Body()]) -> Job:
    """Start a job (train, propose, lift, export, import or copy); it waits for earlier ones of its lane."""
    path = at.project.path
    if isinstance(body, CopyRequest):
        free_path(path.parent, body.name)
    return at.ctx.jobs.add(at.name, path, body, at.operator)


@router.get("/api/jobs")
def jobs(ctx: Ctx, operator: Operator) -> list[Job]:
    """All jobs, the newest first, including those from before the server was started."""
    return ctx.jobs.all()


@router.post("/api/jobs/{id}/cancel")
def cancel(id: RandomId, ctx: Ctx, operator: Operator) -> Job:
    """Stop a job; finished parts of its work are kept."""
    return ctx.jobs.cancel(id)


@router.get("/api/jobs/{id}/download", response_class=FileResponse)
def download(id: RandomId, ctx: Ctx, operator: Operator) -> FileResponse:
    """The packed dataset of an export; the latest ones of each project are kept."""
    path = ctx.jobs.file(id)
    return FileResponse(path, media_type="application/zip", filename=path.name)


@router.get("/api/export-formats")
def formats(operator: Operator) -> list[FormatInfo]:
    """The formats that labels can be exported to, annotator's own first."""
    return [
        FormatInfo(name=name, summary=writer.summary, states=list(writer.states), flat=writer.flat)
        for name, writer in WRITERS.items()
    ]


FileName = Query(alias="name", min_length=1, max_length=255)
Content = Annotated[bytes, Body(media_type="application/octet-stream")]


class BoxesFile(Schema):
    """A file with 2D boxes on camera images, or with 3D boxes.

    Attributes:
        ambiguous: number of its images or frames that fit frames of several recordings: one of these must be chosen.
        boxes: number of boxes that the project has a frame for, by class.
        scores: of 3D boxes: the lowest and the highest score, if there are any.
        source: name that 3D boxes have as a source of proposals, unless another is given.
        found: a sentence about what it has; `notes` say what an import leaves out, replaces or does not change.
    """

    id: str
    name: str
    format: FlatFormat | BoxFormat
    is_3d: bool
    ambiguous: int
    boxes: dict[str, int]
    scores: tuple[float, float] | None
    source: str
    found: str
    notes: tuple[str, ...]


@router.post("/api/projects/{name}/boxes-files", status_code=201)
def upload(at: AtProject, file: Annotated[str, FileName], content: Content) -> BoxesFile:
    """Send a JSON file of 2D or 3D boxes, a CSV file of 3D boxes, or a packed folder of boxes. Nothing is imported."""
    stored = add_upload(at.project, file, content)
    try:
        return _described(at.project, stored, None)
    except BaseException:
        remove_upload(at.project, stored.id)
        raise


@router.get("/api/projects/{name}/boxes-files/{id}")
def look(at: AtProject, id: RandomId, recording: RowId | None = None) -> BoxesFile:
    """A file that was sent, matched with one recording, or with all."""
    return _described(at.project, find_upload(at.project, id), recording)


def _described(project: Project, upload: Upload, recording: int | None) -> BoxesFile:
    name = None if recording is None else project.recordings.get(recording).name
    found = preview_boxes(project, upload.path, upload.format, name)
    return BoxesFile.of(
        found,
        id=upload.id,
        name=upload.path.name,
        format=upload.format,
        scores=None if found.scores is None else (found.scores.low, found.scores.high),
        source=upload.path.stem,
    )


PictureNumber = Annotated[int, Path(ge=0, le=1000)]


class ModelDetails(ModelInfo):
    """A trained detector.

    Attributes:
        boxes: number of boxes it was trained on; null if unknown.
        pictures: URLs of images outside its training data, with its detections.
        decision: how held-out frames decided about it; null if they did not.
    """

    box_kind: BoxKind
    boxes: int | None
    pictures: list[str]
    curves: list[CurvePoint]
    decision: Decision | None


class TrainingData(BaseModel):
    """Numbers of available training data: 2D boxes on camera images and on pseudo-views, and reviewed 3D labels.

    `to_lift`: number of frames with 2D boxes on their image, but no 3D box.
    """

    image: int
    view: int
    labels: int
    to_lift: int


class ModelList(BaseModel):
    """All models, the oldest first, and the available training data.

    Attributes:
        base: whether the base detector is the view detector in use, or could be; null without it.
        learn_every: a round of training in the background after so many reviewed boxes; null: never.
        learn_minutes: length of such a round.
    """

    models: list[ModelDetails]
    base: Literal["in use", "available"] | None
    learn_every: int | None
    learn_minutes: float
    material: TrainingData


@router.get("/api/projects/{name}/models")
def models(at: AtProject) -> ModelList:
    """All detectors of a project."""
    base = "in use" if at.project.models.active(DetectorKind.VIEW) is None else "available"
    counts = at.project.statistics()
    labels = counts.labels.by_state[ReviewState.ACCEPTED] + counts.labels.by_state[ReviewState.EDITED]
    to_lift = len(at.project.boxes.frames_without_labels())
    return ModelList(
        models=[_details(at, model) for model in at.project.models.all()],
        base=base if has_base() else None,
        learn_every=at.project.config.settings.learn_every,
        learn_minutes=at.project.config.settings.learn_minutes,
        material=TrainingData(
            image=counts.image_boxes.boxes, view=counts.view_boxes.boxes, labels=labels, to_lift=to_lift
        ),
    )


class Learning(Schema):
    """To learn while somebody labels: after `every` so many reviewed boxes, for so many minutes; null: never."""

    every: Annotated[int, Field(ge=1, le=1_000_000)] | None
    minutes: Annotated[float, Field(gt=0, le=MOST_MINUTES)] = 3.0


@router.put("/api/projects/{name}/models/learning", status_code=204)
def set_learning(at: AtProject, body: Learning) -> None:
    """Switch rounds of training in the background on or off."""
    settings = at.project.config.settings.model_copy(update={"learn_every": body.every, "learn_minutes": body.minutes})
    at.project.configure(settings=settings)


@router.post("/api/projects/{name}/models/load", status_code=204)
def load(at: AtProject) -> None:
    """Begin to load the detectors in use, since the operator is about to draw."""
    at.ctx.caches.detectors.warm(at.project)


@router.post("/api/projects/{name}/models/base/activate", status_code=204)
def use_base(at: AtProject) -> None:
    """Use the base detector in place of the project's own view detectors."""
    if not has_base():
        raise NotFoundError("this installation has no base detector")
    at.project.models.deactivate(DetectorKind.VIEW)


@router.post("/api/projects/{name}/models/{model}/activate")
def activate(at: AtProject, model: RowId) -> ModelDetails:
    """Make a detector the active one of its role."""
    at.project.models.activate(model)
    return _details(at, at.project.models.get(model))


@router.get("/api/projects/{name}/models/{model}/pictures/{number}.jpg", response_class=FileResponse)
def picture(at: AtProject, model: RowId, number: PictureNumber) -> FileResponse:
    """An image outside a detector's training data, with its detections."""
    pictures = model_facts(at.project.models.get(model)).pictures
    if number >= len(pictures):
        raise NotFoundError(f"model {model} has no picture {number}")
    return FileResponse(pictures[number], media_type="image/jpeg", headers={"Cache-Control": "private, max-age=3600"})


def _details(at: InProject, model: StoredModel) -> ModelDetails:
    facts = model_facts(model)
    return ModelDetails(
        **dict(model_info(model)),
        box_kind=model.box_kind,
        boxes=facts.boxes,
        pictures=[f"/api/projects/{at.name}/models/{model.id}/pictures/{n}.jpg" for n in range(len(facts.pictures))],
        curves=[CurvePoint(role=model.role, epoch=point.epoch, metrics=point.metrics) for point in facts.curves],
        decision=facts.decision,
    )
