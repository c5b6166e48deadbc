"""Trained detectors: list, metrics, sample images, and the choice of the active one."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Path
from fastapi.responses import FileResponse
from pydantic import BaseModel, ConfigDict, Field

from annotator.detection.pretrained import has_base
from annotator.project import Project
from annotator.types import BoxKind, DetectorKind, ReviewState
from annotator.types.errors import NotFoundError
from annotator.web.context import Ctx, Operator
from annotator.web.jobs.records import CurvePoint
from annotator.web.projects import ModelInfo, model_info
from annotator.web.schemas import RowId
from annotator.workflows.training.held_out import Decision
from annotator.workflows.training.model_report import model_facts

router = APIRouter(prefix="/api/projects/{project}/models", tags=["models"])

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
    """

    models: list[ModelDetails]
    base: Literal["in use", "available"] | None
    learn_every: int | None
    material: TrainingData


@router.get("")
def models(project: str, ctx: Ctx, operator: Operator) -> ModelList:
    """All detectors of a project."""
    opened = ctx.project(project)
    details = [_details(project, opened, model.id) for model in opened.models.all()]
    base = "in use" if opened.models.active(DetectorKind.VIEW) is None else "available"
    return ModelList(
        models=details,
        base=base if has_base() else None,
        learn_every=opened.config.settings.learn_every,
        material=_material(opened),
    )


class Learning(BaseModel):
    """Whether to learn while somebody labels.

    Attributes:
        every: a round of training in the background after so many reviewed boxes; null: never.
    """

    model_config = ConfigDict(extra="forbid")

    every: Annotated[int, Field(ge=1, le=1_000_000)] | None


@router.put("/learning", status_code=204)
def set_learning(project: str, body: Learning, ctx: Ctx, operator: Operator) -> None:
    """Switch rounds of training in the background on or off."""
    opened = ctx.project(project)
    opened.configure(settings=opened.config.settings.model_copy(update={"learn_every": body.every}))


@router.post("/load", status_code=204)
def load(project: str, ctx: Ctx, operator: Operator) -> None:
    """Begin to load the detectors in use, since the operator is about to draw."""
    ctx.caches.detectors.warm(ctx.project(project), at_once=True)


@router.post("/base/activate", status_code=204)
def use_base(project: str, ctx: Ctx, operator: Operator) -> None:
    """Use the base detector in place of the project's own view detectors."""
    if not has_base():
        raise NotFoundError("this installation has no base detector")
    ctx.project(project).models.deactivate(DetectorKind.VIEW)


@router.post("/{model}/activate")
def activate(project: str, model: RowId, ctx: Ctx, operator: Operator) -> ModelDetails:
    """Make a detector the active one of its role."""
    opened = ctx.project(project)
    opened.models.activate(model)
    return _details(project, opened, model)


@router.get("/{model}/pictures/{number}.jpg", response_class=FileResponse)
def picture(project: str, model: RowId, number: PictureNumber, ctx: Ctx, operator: Operator) -> FileResponse:
    """An image outside a detector's training data, with its detections."""
    pictures = model_facts(ctx.project(project).models.get(model)).pictures
    if number >= len(pictures):
        raise NotFoundError(f"model {model} has no picture {number}")
    return FileResponse(pictures[number], media_type="image/jpeg", headers={"Cache-Control": "private, max-age=3600"})


def _details(name: str, project: Project, model_id: int) -> ModelDetails:
    model = project.models.get(model_id)
    facts = model_facts(model)
    return ModelDetails(
        **model_info(model).model_dump(),
        box_kind=model.box_kind,
        boxes=facts.boxes,
        pictures=[f"/api/projects/{name}/models/{model.id}/pictures/{n}.jpg" for n in range(len(facts.pictures))],
        curves=[CurvePoint(role=model.role, epoch=point.epoch, metrics=point.metrics) for point in facts.curves],
        decision=facts.decision,
    )


def _material(project: Project) -> TrainingData:
    counts = project.statistics()
    labels = counts.labels.by_state[ReviewState.ACCEPTED] + counts.labels.by_state[ReviewState.EDITED]
    to_lift = len(project.boxes.frames_without_labels())
    return TrainingData(image=counts.image_boxes.boxes, view=counts.view_boxes.boxes, labels=labels, to_lift=to_lift)
