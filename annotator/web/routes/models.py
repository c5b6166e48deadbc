"""Trained detectors: list, metrics, sample images, and the choice of the active one."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path
from fastapi.responses import FileResponse
from pydantic import BaseModel

from annotator.project import Project
from annotator.types import BoxKind, ReviewState
from annotator.types.errors import NotFoundError
from annotator.web.context import Ctx, Operator
from annotator.web.jobs.records import CurvePoint
from annotator.web.projects import ModelInfo, model_info
from annotator.web.schemas import RowId
from annotator.workflows.training.model_report import model_facts

router = APIRouter(prefix="/api/projects/{project}/models", tags=["models"])

PictureNumber = Annotated[int, Path(ge=0, le=1000)]


class ModelDetails(ModelInfo):
    """A trained detector.

    Attributes:
        boxes: number of boxes it was trained on; null if unknown.
        pictures: URLs of images outside its training data, with its detections.
    """

    box_kind: BoxKind
    boxes: int | None
    pictures: list[str]
    curves: list[CurvePoint]


class TrainingData(BaseModel):
    """Numbers of available training data: 2D boxes on camera images and on pseudo-views, and reviewed 3D labels.

    `to_lift`: number of frames with 2D boxes on their image, but no 3D box.
    """

    image: int
    view: int
    labels: int
    to_lift: int


class ModelList(BaseModel):
    """All models, the oldest first, and the available training data."""

    models: list[ModelDetails]
    material: TrainingData


@router.get("")
def models(project: str, ctx: Ctx, operator: Operator) -> ModelList:
    """All detectors of a project."""
    opened = ctx.project(project)
    details = [_details(project, opened, model.id) for model in opened.models.all()]
    return ModelList(models=details, material=_material(opened))


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
    )


def _material(project: Project) -> TrainingData:
    counts = project.statistics()
    labels = counts.labels.by_state[ReviewState.ACCEPTED] + counts.labels.by_state[ReviewState.EDITED]
    to_lift = len(project.boxes.frames_without_labels())
    return TrainingData(image=counts.image_boxes.boxes, view=counts.view_boxes.boxes, labels=labels, to_lift=to_lift)
