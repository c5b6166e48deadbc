"""Label mode: the views and the 3D box from the boxes drawn so far, suggestions, and saving."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from fastapi import APIRouter
from pydantic import Field

from annotator.geometry.outline import visible_edges
from annotator.project import Project
from annotator.types import BoxKind, DetectorKind
from annotator.web.context import Context, Ctx, Operator
from annotator.web.frame_json import STALE, both_versions, drawn_view, frame_state
from annotator.web.schemas import (
    MOST_BOXES,
    Axes,
    Box2DJson,
    Box2DOut,
    Box3DOut,
    FrameChange,
    FrameStateJson,
    ImageBoxIn,
    Outline,
    RowId,
    Schema,
    SuggestionJson,
    Uid,
    ViewJson,
)
from annotator.workflows.workbench.drawing_steps import Labelling, frame_config, label_object
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.loaded_detectors import Readiness
from annotator.workflows.workbench.save_object import ObjectDrawn, save_object, suggested_image_boxes

router = APIRouter(tags=["label"])

# Maximum time to wait for a detector that is being loaded, since the page waits for the views.
LOADING_WAIT_S = 0.1

ViewBoxesIn = Annotated[list[Box2DJson | None], Field(max_length=4)]


class DrawnIn(Schema):
    """An object with the boxes drawn so far.

    `axes` are those of the second step's front view (`ViewJson`); null while no box is drawn on that step.
    """

    image_box: Box2DJson
    boxes: ViewBoxesIn
    axes: Axes | None = None


class StepsIn(DrawnIn):
    """An object with the boxes drawn so far, and what they measure. `suggest`: also suggest the others."""

    box_kind: BoxKind = BoxKind.SILHOUETTE
    suggest: bool = True


class StepJson(Schema):
    """The front and side view of a step, and the boxes that are suggested on those without a drawn one."""

    views: list[ViewJson]
    suggested: list[Box2DOut | None]


class StepsOut(Schema):
    """The steps so far, the 3D box of the drawn and suggested boxes with its number of points, and why there is no
    further step.

    While `detector` is "loading", a later request returns suggestions; `problem` is the reason why it failed.
    `measured_by` names the detector, `suggestion` is what a label records that its boxes are accepted for; `note` is
    the reason why it suggests nothing.
    """

    steps: list[StepJson]
    box: Box3DOut | None
    outline: Outline | None
    points: int
    stop: str | None
    detector: Literal["none", "loading", "ready", "failed"]
    measured_by: str | None
    suggestion: SuggestionJson | None
    problem: str | None
    note: str | None


class ObjectIn(DrawnIn):
    """An object with the boxes drawn so far; its label's uid, if it has one; the detector that suggested its boxes."""

    uid: Uid | None = None
    suggestion: SuggestionJson | None = None


class SaveIn(FrameChange):
    """All boxes of the image, and the object that was changed."""

    image_boxes: Annotated[list[Box2DJson], Field(max_length=MOST_BOXES)]
    box_kind: BoxKind = BoxKind.SILHOUETTE
    object: ObjectIn | None = None
    subject: Uid | None = None


class SaveOut(Schema):
    """The present state, the uid of the object's label if the object is finished, and the object's steps."""

    state: FrameStateJson
    uid: str | None
    drawn: StepsOut | None


class WholeBoxJson(Schema):
    """A whole box with its outline on the image."""

    box: Box3DOut
    outline: Outline


class WholeOut(Schema):
    """The whole boxes that are offered, best first."""

    boxes: list[WholeBoxJson]


class SuggestionsOut(Schema):
    """Boxes of the image detector, best first; empty without a detector, or if it failed (`problem`)."""

    boxes: list[Box2DOut]
    problem: str | None = None


@router.post("/api/projects/{name}/frames/{frame_id}/label/steps")
def steps(ctx: Ctx, operator: Operator, name: str, frame_id: RowId, body: StepsIn) -> StepsOut:
    """The views for an object's boxes so far, with suggestions, and its 3D box. Nothing is stored."""
    project = ctx.project(name)
    opened = ctx.caches.frames.open(project, frame_id, operator)
    labelling, ready = _labelled(ctx, project, opened, body, body.box_kind, body.suggest)
    return _steps_json(ctx, name, opened, labelling, ready)


def _labelled(
    ctx: Context, project: Project, opened: OpenFrame, body: DrawnIn, kind: BoxKind, suggest: bool = True
) -> tuple[Labelling, Readiness]:
    """The state of a drawn object, and that of the view detector that suggests its boxes."""
    ready = ctx.caches.detectors.readiness(project, DetectorKind.VIEW, LOADING_WAIT_S if suggest else 0.0)
    detector = ready.detector if suggest else None
    boxes = [None if box is None else box.box() for box in body.boxes]
    axes = None if body.axes is None else np.array(body.axes)
    return label_object(project, opened, body.image_box.box(), boxes, kind, axes, detector), ready


def _steps_json(ctx: Context, name: str, opened: OpenFrame, labelling: Labelling, ready: Readiness) -> StepsOut:
    return StepsOut(
        steps=[
            StepJson(
                views=[drawn_view(ctx, name, view, opened.picture(view)) for view in step.views],
                suggested=[None if box is None else Box2DOut.of(box) for box in step.suggested],
            )
            for step in labelling.steps
        ],
        box=None if labelling.box is None else Box3DOut.of(labelling.box),
        outline=None if labelling.box is None else labelling.outline.round(2).tolist(),
        points=labelling.points,
        stop=labelling.stop,
        detector=ready.state,
        measured_by=None if ready.detector is None else ready.detector.title,
        suggestion=None if ready.detector is None else SuggestionJson.of(ready.detector.suggestion),
        problem=None if ready.problem is None else ctx.public_message(ready.problem),
        note=None if labelling.note is None else ctx.public_message(labelling.note),
    )


@router.post("/api/projects/{name}/frames/{frame_id}/label/whole")
def whole(ctx: Ctx, operator: Operator, name: str, frame_id: RowId, body: ImageBoxIn) -> WholeOut:
    """The whole boxes that are offered for an object whose silhouettes are drawn. Nothing is stored."""
    project = ctx.project(name)
    opened = ctx.caches.frames.open(project, frame_id, operator)
    detector = ctx.caches.detectors.readiness(project, DetectorKind.VIEW, LOADING_WAIT_S).detector
    stored = project.frames.get(frame_id)
    offers = ctx.caches.whole_boxes(project).of(opened.frame, stored, body.image_box.box(), detector)
    outlines = visible_edges(opened.frame.camera, [offer.box for offer in offers])
    return WholeOut(
        boxes=[
            WholeBoxJson(box=Box3DOut.of(offer.box), outline=outline.round(2).tolist())
            for offer, outline in zip(offers, outlines, strict=True)
        ]
    )


@router.get("/api/projects/{name}/frames/{frame_id}/label/suggestions", response_model_exclude_none=True)
def suggestions(ctx: Ctx, operator: Operator, name: str, frame_id: RowId) -> SuggestionsOut:
    """Boxes that the image detector suggests."""
    project = ctx.project(name)
    ready = ctx.caches.detectors.readiness(project, DetectorKind.IMAGE)
    if ready.detector is None:
        return SuggestionsOut(boxes=[], problem=None if ready.problem is None else ctx.public_message(ready.problem))
    opened = ctx.caches.frames.open(project, frame_id, operator)
    min_score = frame_config(project, opened.frame).min_image_score
    boxes = suggested_image_boxes(opened, ready.detector, min_score, project.config.classes)
    return SuggestionsOut(boxes=[Box2DOut.of(box) for box in boxes])


@router.post("/api/projects/{name}/frames/{frame_id}/label/object", responses=STALE)
def save(ctx: Ctx, operator: Operator, name: str, frame_id: RowId, body: SaveIn) -> SaveOut:
    """Store the drawn boxes and suggest the others; an object with all four boxes on its views becomes a label."""
    project = ctx.project(name)
    opened = ctx.caches.frames.open(project, frame_id, operator)
    image_boxes = [box.box() for box in body.image_boxes]
    drawn = answer = None
    if body.object is not None:
        on_views = [None if box is None else box.box() for box in body.object.boxes]
        labelling, ready = _labelled(ctx, project, opened, body.object, body.box_kind)
        suggested = None if body.object.suggestion is None else body.object.suggestion.stored()
        drawn = ObjectDrawn(body.object.image_box.box(), on_views, labelling, body.object.uid, suggested)
        answer = _steps_json(ctx, name, opened, labelling, ready)
    with both_versions(ctx, name, frame_id, operator, body):
        context = body.context(operator, body.subject)
        saved = save_object(project, frame_id, opened, image_boxes, body.box_kind, drawn, context)
    if saved.receipt is not None:
        ctx.hub.frame_changed(project, frame_id, saved.receipt.revision, operator)
    return SaveOut.model_construct(state=frame_state(ctx, name, frame_id, operator), uid=saved.uid, drawn=answer)
