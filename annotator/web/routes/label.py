"""Label mode: what the drags lead to, and keeping them."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter
from fastapi.responses import JSONResponse
from pydantic import Field

from annotator.project import Change, Role
from annotator.types import BoxKind
from annotator.types.errors import StaleRevisionError
from annotator.web.answers import stale_answer
from annotator.web.context import Ctx, Operator
from annotator.web.routes.frames import STALE
from annotator.web.shown import drawn_view, frame_state
from annotator.web.wire import (
    MOST_BOXES,
    Box2DJson,
    Box2DOut,
    Box3DOut,
    Effort,
    FrameStateJson,
    Outline,
    RowId,
    Uid,
    ViewJson,
    Wire,
)
from annotator.workflows.label_object import ObjectDrawn, save_object, suggested_image_boxes
from annotator.workflows.labelling import frame_config, label_config, label_steps

router = APIRouter(tags=["label"])

# A page that waits for its views shall not wait for a detector that is still being loaded.
LOADING_WAIT_S = 0.1

ViewBoxesIn = Annotated[list[Box2DJson | None], Field(max_length=4)]


class StepsIn(Wire):
    """An object as far as it is drawn. Without `suggest` the answer waits for no detector."""

    image_box: Box2DJson
    boxes: ViewBoxesIn
    box_kind: BoxKind = BoxKind.SILHOUETTE
    suggest: bool = True


class StepJson(Wire):
    """Front and side view of a step, and boxes that the view detector suggests on them."""

    views: list[ViewJson]
    suggested: list[Box2DOut | None]


class StepsOut(Wire):
    """What the drags have led to: the cross-view box so far, how many points it holds, why it goes no further.

    While `detector` is loading, the same question brings suggestions a little later; `problem` says why it failed.
    """

    steps: list[StepJson]
    box: Box3DOut | None
    outline: Outline | None
    points: int
    stop: str | None
    detector: Literal["none", "loading", "ready", "failed"]
    problem: str | None


class ObjectIn(Wire):
    """An object as far as it is drawn; its label's uid, if it has become one."""

    image_box: Box2DJson
    boxes: ViewBoxesIn
    uid: Uid | None = None


class SaveIn(Wire):
    """All boxes of the image, and the object that was worked on."""

    revision: RowId
    image_boxes: Annotated[list[Box2DJson], Field(max_length=MOST_BOXES)]
    box_kind: BoxKind = BoxKind.SILHOUETTE
    object: ObjectIn | None = None
    effort: Effort | None = None
    subject: Uid | None = None


class SaveOut(Wire):
    """What is there now, and the uid of the object's label, if it is finished."""

    state: FrameStateJson
    uid: str | None


class SuggestionsOut(Wire):
    """What the image detector finds, best first; none where there is no detector yet, or (`problem`) it failed."""

    boxes: list[Box2DOut]
    problem: str | None = None


@router.post("/api/projects/{name}/frames/{frame_id}/label/steps")
def steps(ctx: Ctx, who: Operator, name: str, frame_id: RowId, body: StepsIn) -> StepsOut:
    """The views that an object's drags lead to, with suggestions, and its box so far. Nothing is kept."""
    project = ctx.project(name)
    opened = ctx.annotation.frames.open(project, frame_id, who)
    ready = ctx.annotation.detectors.look(project, Role.VIEW, LOADING_WAIT_S if body.suggest else 0.0)
    detector = ready.detector if body.suggest else None
    boxes = [None if box is None else box.box() for box in body.boxes]
    config = label_config(project, opened.frame)
    found = label_steps(opened, body.image_box.box(), boxes, config, body.box_kind, detector)
    return StepsOut(
        steps=[
            StepJson(
                views=[drawn_view(ctx, name, view) for view in step.views],
                suggested=[None if box is None else Box2DOut.of(box) for box in step.suggested],
            )
            for step in found.steps
        ],
        box=None if found.box is None else Box3DOut.of(found.box),
        outline=None if found.box is None else found.outline.round(2).tolist(),
        points=found.points,
        stop=found.stop,
        detector=ready.state,
        problem=None if ready.problem is None else ctx.told(ready.problem),
    )


@router.get("/api/projects/{name}/frames/{frame_id}/label/suggestions", response_model_exclude_none=True)
def suggestions(ctx: Ctx, who: Operator, name: str, frame_id: RowId) -> SuggestionsOut:
    """Boxes that the image detector suggests."""
    project = ctx.project(name)
    ready = ctx.annotation.detectors.look(project, Role.IMAGE)
    if ready.detector is None:
        return SuggestionsOut(boxes=[], problem=None if ready.problem is None else ctx.told(ready.problem))
    opened = ctx.annotation.frames.open(project, frame_id, who)
    least = frame_config(project, opened.frame).min_image_score
    found = suggested_image_boxes(opened, ready.detector, least, project.config.classes)
    return SuggestionsOut(boxes=[Box2DOut.of(box) for box in found])


@router.post("/api/projects/{name}/frames/{frame_id}/label/object", response_model=SaveOut, responses=STALE)
def save(ctx: Ctx, who: Operator, name: str, frame_id: RowId, body: SaveIn) -> SaveOut | JSONResponse:
    """Keeps what was drawn; with all four boxes on its views, the object becomes a label."""
    project = ctx.project(name)
    opened = ctx.annotation.frames.open(project, frame_id, who)
    effort = None if body.effort is None else body.effort.stored()
    change = Change(body.revision, who, effort=effort, subject=body.subject)
    image_boxes = [box.box() for box in body.image_boxes]
    drawn = None
    if body.object is not None:
        on_views = [None if box is None else box.box() for box in body.object.boxes]
        drawn = ObjectDrawn(body.object.image_box.box(), on_views, body.object.uid)
    try:
        saved = save_object(project, frame_id, opened, image_boxes, body.box_kind, drawn, change)
    except StaleRevisionError as error:
        return stale_answer(ctx, name, frame_id, who, error, [body.model_dump(mode="json")])
    if saved.receipt is not None:
        ctx.hub.frame_changed(name, frame_id, saved.receipt.revision, who)
    return SaveOut.model_construct(state=frame_state(ctx, name, frame_id, who), uid=saved.uid)
