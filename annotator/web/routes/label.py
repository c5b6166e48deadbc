"""Label mode: the views and the 3D box from the boxes drawn so far, suggestions, and saving."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from fastapi import APIRouter
from pydantic import Field

from annotator.geometry.outline import visible_edges
from annotator.types import Box2D, BoxKind, DetectorKind, Suggestion
from annotator.web.frame_json import STALE, AtFrame, InFrame, drawn_view
from annotator.web.schemas import (
    MOST_BOXES,
    Axes,
    Box2DJson,
    Box3DJson,
    FrameChange,
    FrameStateJson,
    ImageBoxIn,
    Outline,
    Schema,
    Uid,
    ViewJson,
)
from annotator.workflows.workbench.drawing_steps import Labelling, frame_config, label_object
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.loaded_detectors import Readiness
from annotator.workflows.workbench.save_object import ObjectDrawn, save_object

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

    def drawn(self) -> list[Box2D | None]:
        return [None if box is None else box.box() for box in self.boxes]


class StepsIn(DrawnIn):
    """An object with the boxes drawn so far, and what they measure. `suggest`: also suggest the others."""

    box_kind: BoxKind = BoxKind.SILHOUETTE
    suggest: bool = True


class StepJson(Schema):
    """The front and side view of a step, and the boxes that are suggested on those without a drawn one."""

    views: list[ViewJson]
    suggested: list[Box2DJson | None]


class StepsOut(Schema):
    """The steps so far, the 3D box of the drawn and suggested boxes with its number of points, and why there is no
    further step.

    While `detector` is "loading", a later request returns suggestions; `problem` is the reason why it failed.
    `measured_by` names the detector, `suggestion` is what a label records that its boxes are accepted for; `note` is
    the reason why it suggests nothing.
    """

    steps: list[StepJson]
    box: Box3DJson | None
    outline: Outline | None
    points: int
    stop: str | None
    detector: Literal["none", "loading", "ready", "failed"]
    measured_by: str | None
    suggestion: Suggestion | None
    problem: str | None
    note: str | None


class ObjectIn(DrawnIn):
    """An object with the boxes drawn so far; its label's uid, if it has one; the detector that suggested its boxes."""

    uid: Uid | None = None
    suggestion: Suggestion | None = None


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

    box: Box3DJson
    outline: Outline


class WholeOut(Schema):
    """The whole boxes that are offered, best first."""

    boxes: list[WholeBoxJson]


class SuggestionsOut(Schema):
    """Boxes of the image detector, best first; empty without a detector, or if it failed (`problem`)."""

    boxes: list[Box2DJson]
    problem: str | None = None


@router.post("/api/projects/{name}/frames/{frame_id}/label/steps")
def steps(at: AtFrame, body: StepsIn) -> StepsOut:
    """The views for an object's boxes so far, with suggestions, and its 3D box. Nothing is stored."""
    opened = at.open()
    return _steps_json(at, opened, *_labelled(at, opened, body, body.box_kind, body.suggest))


def _labelled(
    at: InFrame, opened: OpenFrame, body: DrawnIn, kind: BoxKind, suggest: bool = True
) -> tuple[Labelling, Readiness]:
    """The state of a drawn object, and that of the view detector that suggests its boxes."""
    ready = at.ctx.caches.detectors.readiness(at.project, DetectorKind.VIEW, LOADING_WAIT_S if suggest else 0.0)
    detector = ready.detector if suggest else None
    axes = None if body.axes is None else np.array(body.axes)
    return label_object(at.project, opened, body.image_box.box(), body.drawn(), kind, axes, detector), ready


def _steps_json(at: InFrame, opened: OpenFrame, labelling: Labelling, ready: Readiness) -> StepsOut:
    detector = ready.detector
    return StepsOut(
        steps=[
            StepJson(
                views=[drawn_view(at, view, opened.picture(view)) for view in step.views],
                suggested=[None if box is None else Box2DJson.of(box) for box in step.suggested],
            )
            for step in labelling.steps
        ],
        box=None if labelling.box is None else Box3DJson.of(labelling.box),
        outline=None if labelling.box is None else labelling.outline.round(2).tolist(),
        points=labelling.points,
        stop=labelling.stop,
        detector=ready.state,
        measured_by=None if detector is None else detector.title,
        suggestion=None if detector is None else detector.suggestion,
        problem=at.ctx.public(ready.problem),
        note=at.ctx.public(labelling.note),
    )


@router.post("/api/projects/{name}/frames/{frame_id}/label/whole")
def whole(at: AtFrame, body: ImageBoxIn) -> WholeOut:
    """The whole boxes that are offered for an object whose silhouettes are drawn. Nothing is stored."""
    frame, caches = at.open().frame, at.ctx.caches
    detector = caches.detectors.readiness(at.project, DetectorKind.VIEW, LOADING_WAIT_S).detector
    stored = at.project.frames.get(at.frame_id)
    offers = caches.whole_boxes(at.project).of(frame, stored, body.image_box.box(), detector)
    outlines = visible_edges(frame.camera, [offer.box for offer in offers])
    return WholeOut(
        boxes=[
            WholeBoxJson(box=Box3DJson.of(offer.box), outline=outline.round(2).tolist())
            for offer, outline in zip(offers, outlines, strict=True)
        ]
    )


@router.get("/api/projects/{name}/frames/{frame_id}/label/suggestions", response_model_exclude_none=True)
def suggestions(at: AtFrame) -> SuggestionsOut:
    """Boxes that the image detector suggests."""
    ready = at.ctx.caches.detectors.readiness(at.project, DetectorKind.IMAGE)
    if ready.detector is None:
        return SuggestionsOut(boxes=[], problem=at.ctx.public(ready.problem))
    opened = at.open()
    min_score = frame_config(at.project, opened.frame).min_image_score
    classes = at.project.config.classes
    found = [box for box in opened.image_detections(ready.detector) if box.score >= min_score and box.label in classes]
    return SuggestionsOut(boxes=[Box2DJson.of(box) for box in found])


@router.post("/api/projects/{name}/frames/{frame_id}/label/object", responses=STALE)
def save(at: AtFrame, body: SaveIn) -> SaveOut:
    """Store the drawn boxes and suggest the others; an object with all four boxes on its views becomes a label."""
    opened, given = at.open(), body.object
    drawn = answer = None
    if given is not None:
        labelling, ready = _labelled(at, opened, given, body.box_kind)
        drawn = ObjectDrawn(given.image_box.box(), given.drawn(), labelling, given.uid, given.suggestion)
        answer = _steps_json(at, opened, labelling, ready)
    with at.change(body) as changed:
        image_boxes, context = [box.box() for box in body.image_boxes], body.context(at.operator, body.subject)
        saved = save_object(at.project, at.frame_id, opened, image_boxes, body.box_kind, drawn, context)
        if saved.receipt is not None:
            changed.append((at.frame_id, saved.receipt))
    return SaveOut.model_construct(state=at.state(), uid=saved.uid, drawn=answer)
