"""Review mode: pictures along a box's own axes, fitting it anew, boxes from the frame before."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter
from fastapi.responses import JSONResponse
from pydantic import Field

from annotator.project import Change, Role
from annotator.rcv.config import RcvConfig
from annotator.types.errors import StaleRevisionError
from annotator.web.answers import stale_answer
from annotator.web.context import Context, Ctx, Operator
from annotator.web.routes.frames import STALE
from annotator.web.shown import drawn_view, frame_state, quality_json
from annotator.web.wire import (
    Box2DJson,
    Box3DJson,
    Box3DOut,
    ClassName,
    Effort,
    FrameStateJson,
    Outline,
    QualityJson,
    RowId,
    ViewJson,
    Wire,
)
from annotator.workflows.copying import copy_boxes
from annotator.workflows.detectors_ready import Readiness
from annotator.workflows.labelling import frame_config
from annotator.workflows.open_frame import OpenFrame
from annotator.workflows.ortho import ortho_views
from annotator.workflows.refit import find_box, refit

router = APIRouter(tags=["review"])


class OrthoIn(Wire):
    """A box, and how large its pictures shall be."""

    box: Box3DJson
    size_px: Annotated[int, Field(ge=32, le=1024)] = 320


class OrthoView(ViewJson):
    """A picture along the box's own axes."""

    name: Literal["top", "front", "side"]


class OrthoOut(Wire):
    """The three pictures."""

    views: list[OrthoView]


class RefitIn(Wire):
    """A box and its class."""

    box: Box3DJson
    label: ClassName


class RefitOut(Wire):
    """The box fitted anew, how, and what should be known about it."""

    box: Box3DOut
    outline: Outline
    quality: QualityJson | None
    method: Literal["rcv", "points"]
    note: str | None


class FitIn(Wire):
    """A box that was drawn on the image."""

    image_box: Box2DJson


class FitOut(Wire):
    """The object in it; without `box` it was not found, and `note` says why."""

    box: Box3DOut | None
    outline: Outline
    points: int
    score: float | None
    quality: QualityJson | None
    note: str | None


class CopyIn(Wire):
    """The frame to copy from; null = the one before."""

    revision: RowId
    source: Annotated[RowId | None, Field(alias="from")] = None
    effort: Effort | None = None


@router.post("/api/projects/{name}/frames/{frame_id}/ortho")
def ortho(ctx: Ctx, who: Operator, name: str, frame_id: RowId, body: OrthoIn) -> OrthoOut:
    """Three pictures along the box's own axes; what lies around it is dimmed."""
    opened = ctx.annotation.frames.open(ctx.project(name), frame_id, who)
    found = ortho_views(opened, body.box.box(), body.size_px)
    views = [OrthoView(name=item.name, **dict(drawn_view(ctx, name, item.view))) for item in found]
    return OrthoOut(views=views)


@router.post("/api/projects/{name}/frames/{frame_id}/refit")
def fit_anew(ctx: Ctx, who: Operator, name: str, frame_id: RowId, body: RefitIn) -> RefitOut:
    """The box fitted anew from where it is. Nothing is kept."""
    opened, config, ready = _ready(ctx, name, frame_id, who)
    found = refit(opened, body.box.box(), body.label, config, ready.detector, ready.problem)
    return RefitOut(
        box=Box3DOut.of(found.box),
        outline=found.outline.round(2).tolist(),
        quality=quality_json(found.quality),
        method=found.method,
        note=None if found.note is None else ctx.told(found.note),
    )


@router.post("/api/projects/{name}/frames/{frame_id}/fit")
def fit(ctx: Ctx, who: Operator, name: str, frame_id: RowId, body: FitIn) -> FitOut:
    """The object in a box on the image. Nothing is kept."""
    opened, config, ready = _ready(ctx, name, frame_id, who)
    found = find_box(opened, body.image_box.box(), config, ready.detector, ready.problem)
    return FitOut(
        box=None if found.box is None else Box3DOut.of(found.box),
        outline=found.outline.round(2).tolist(),
        points=found.points,
        score=found.score,
        quality=quality_json(found.quality),
        note=None if found.note is None else ctx.told(found.note),
    )


def _ready(ctx: Context, name: str, frame_id: int, who: str) -> tuple[OpenFrame, RcvConfig, Readiness]:
    """A frame, the recursion's settings for it, and how far the project's detector for pseudo-views is."""
    project = ctx.project(name)
    opened = ctx.annotation.frames.open(project, frame_id, who)
    ready = ctx.annotation.detectors.look(project, Role.VIEW)
    config = frame_config(project, opened.frame)
    if ready.detector is not None:
        config = config.model_copy(update={"box_kind": ready.detector.box_kind})
    return opened, config, ready


@router.post("/api/projects/{name}/frames/{frame_id}/copy", response_model=FrameStateJson, responses=STALE)
def copy(ctx: Ctx, who: Operator, name: str, frame_id: RowId, body: CopyIn) -> FrameStateJson | JSONResponse:
    """The reviewed boxes of another frame, as far as this one does not have them."""
    effort = None if body.effort is None else body.effort.stored()
    try:
        receipt = copy_boxes(ctx.project(name), frame_id, body.source, Change(body.revision, who, effort=effort))
    except StaleRevisionError as error:
        return stale_answer(ctx, name, frame_id, who, error, [body.model_dump(mode="json", by_alias=True)])
    ctx.hub.frame_changed(name, frame_id, receipt.revision, who)
    return frame_state(ctx, name, frame_id, who)
