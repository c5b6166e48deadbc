"""Review mode: views along a box's axes, refitting a box, fitting a box to an image box, copying boxes."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter
from fastapi.responses import JSONResponse
from pydantic import Field

from annotator.project import WriteContext
from annotator.project.views import png
from annotator.rcv.config import RcvConfig
from annotator.types import BoxKind, DetectorKind
from annotator.types.errors import StaleRevisionError
from annotator.web.context import Context, Ctx, Operator
from annotator.web.frame_json import STALE, drawn_view, frame_state, quality_json, stale_response
from annotator.web.schemas import (
    Box2DJson,
    Box3DJson,
    Box3DOut,
    ClassName,
    Effort,
    FrameStateJson,
    Outline,
    QualityJson,
    RowId,
    Schema,
    SuggestionJson,
    ViewJson,
)
from annotator.workflows.workbench.copy_boxes import copy_boxes
from annotator.workflows.workbench.drawing_steps import frame_config
from annotator.workflows.workbench.loaded_detectors import Readiness
from annotator.workflows.workbench.open_frame import OpenFrame
from annotator.workflows.workbench.ortho_views import ortho_views
from annotator.workflows.workbench.refit import RCV, find_box, refit

router = APIRouter(tags=["review"])


class OrthoIn(Schema):
    """A box, and the size of its views."""

    box: Box3DJson
    size_px: Annotated[int, Field(ge=32, le=1024)] = 320


class OrthoView(ViewJson):
    """A view along an axis of the box: from above, from its front, or of its right side."""

    name: Literal["top", "front", "side"]


class OrthoOut(Schema):
    """The three views."""

    views: list[OrthoView]


class RefitIn(Schema):
    """A box and its class."""

    box: Box3DJson
    label: ClassName


class RefitOut(Schema):
    """The refitted box, the method, the name of the detector that measured it, if one did, and a note."""

    box: Box3DOut
    outline: Outline
    quality: QualityJson | None
    method: Literal["rcv", "points"]
    measured_by: str | None
    note: str | None


class FitIn(Schema):
    """A box that was drawn on the image."""

    image_box: Box2DJson


class FitOut(Schema):
    """The object in an image box; if none was found, `box` is null and `note` is the reason.

    `measured_by` names the detector that looked for it; `suggestion` is what a label made from it records. With
    `too_few_points`, it cannot be drawn by hand on views either.
    """

    box: Box3DOut | None
    outline: Outline
    points: int
    score: float | None
    quality: QualityJson | None
    measured_by: str | None
    suggestion: SuggestionJson | None
    note: str | None
    too_few_points: bool


class CopyIn(Schema):
    """The frame to copy from; null = the previous one."""

    revision: RowId
    source: Annotated[RowId | None, Field(alias="from")] = None
    effort: Effort | None = None


@router.post("/api/projects/{name}/frames/{frame_id}/ortho")
def ortho(ctx: Ctx, operator: Operator, name: str, frame_id: RowId, body: OrthoIn) -> OrthoOut:
    """Three views along the box's axes; points outside the box are dimmed."""
    opened = ctx.caches.frames.open(ctx.project(name), frame_id, operator)
    drawn = ortho_views(opened, body.box.box(), body.size_px)
    views = [OrthoView(name=item.name, **dict(drawn_view(ctx, name, item.view, png(item.view.rgb)))) for item in drawn]
    return OrthoOut(views=views)


@router.post("/api/projects/{name}/frames/{frame_id}/refit")
def refit_box(ctx: Ctx, operator: Operator, name: str, frame_id: RowId, body: RefitIn) -> RefitOut:
    """Refit a box, starting from its present pose. Nothing is stored."""
    opened, config, ready = _ready(ctx, name, frame_id, operator)
    fitted = refit(opened, body.box.box(), body.label, config, ready.detector, ready.problem)
    return RefitOut(
        box=Box3DOut.of(fitted.box),
        outline=fitted.outline.round(2).tolist(),
        quality=quality_json(fitted.quality),
        method=fitted.method,
        measured_by=ready.detector.title if ready.detector is not None and fitted.method == RCV else None,
        note=None if fitted.note is None else ctx.public_message(fitted.note),
    )


@router.post("/api/projects/{name}/frames/{frame_id}/fit")
def fit(ctx: Ctx, operator: Operator, name: str, frame_id: RowId, body: FitIn) -> FitOut:
    """Find the object in an image box. Nothing is stored."""
    opened, config, ready = _ready(ctx, name, frame_id, operator)
    fitted = find_box(opened, body.image_box.box(), config, ready.detector, ready.problem)
    return FitOut(
        box=None if fitted.box is None else Box3DOut.of(fitted.box),
        outline=fitted.outline.round(2).tolist(),
        points=fitted.points,
        score=fitted.score,
        quality=quality_json(fitted.quality),
        measured_by=None if ready.detector is None else ready.detector.title,
        suggestion=None if ready.detector is None else SuggestionJson.of(ready.detector.suggestion),
        note=None if fitted.note is None else ctx.public_message(fitted.note),
        too_few_points=fitted.too_few_points,
    )


def _ready(ctx: Context, name: str, frame_id: int, operator: str) -> tuple[OpenFrame, RcvConfig, Readiness]:
    """A frame, the recursion's settings for it, and the state of the project's view detector."""
    project = ctx.project(name)
    opened = ctx.caches.frames.open(project, frame_id, operator)
    ready = ctx.caches.detectors.readiness(project, DetectorKind.VIEW)
    drawn = project.boxes.on_image(frame_id)
    image_kind = BoxKind.BOX if drawn is None else drawn.box_kind
    return opened, frame_config(project, opened.frame, ready.detector, image_kind=image_kind), ready


@router.post("/api/projects/{name}/frames/{frame_id}/copy", response_model=FrameStateJson, responses=STALE)
def copy(ctx: Ctx, operator: Operator, name: str, frame_id: RowId, body: CopyIn) -> FrameStateJson | JSONResponse:
    """Copy the reviewed boxes of another frame, except those that this frame already has."""
    project, effort = ctx.project(name), None if body.effort is None else body.effort.stored()
    try:
        receipt = copy_boxes(project, frame_id, body.source, WriteContext(body.revision, operator, effort=effort))
    except StaleRevisionError as error:
        return stale_response(ctx, name, frame_id, operator, error, [body.model_dump(mode="json", by_alias=True)])
    ctx.hub.frame_changed(project, frame_id, receipt.revision, operator)
    return frame_state(ctx, name, frame_id, operator)
