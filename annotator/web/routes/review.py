"""Boxes in Annotate: the views and the 3D box of what is drawn so far, suggestions, saving; views along a box's
axes, refitting, fitting to an image box, copying; the queue, statistics and checks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from fastapi import APIRouter, Query
from pydantic import Field

from annotator.geometry.outline import visible_edges
from annotator.image_bytes import encoded_image
from annotator.project.classes.attributes import AttributeOf
from annotator.project.review import ValueFilter, waiting_sources
from annotator.rcv.config import RcvConfig
from annotator.types import Box2D, BoxKind, DetectorKind, ReviewState, Suggestion
from annotator.web.context import AtProject
from annotator.web.frame_json import STALE, AtFrame, InFrame, drawn_view
from annotator.web.schemas import (
    MOST_BOXES,
    Box2DJson,
    Box3DJson,
    ClassName,
    FrameChange,
    FrameStateJson,
    ImageBoxIn,
    Outline,
    Planes,
    QualityJson,
    Schema,
    Uid,
    Vector3,
    ViewJson,
)
from annotator.workflows.checking.project_labels import CheckReport, check_project
from annotator.workflows.detectors import ReportedStatistics, reported_statistics
from annotator.workflows.importing.boxes_3d import MOST_NAME
from annotator.workflows.workbench.contact_sheet import ortho_views
from annotator.workflows.workbench.drawing_steps import VIEWS_PER_STEP, Labelling, frame_config, label_object
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.loaded_detectors import Readiness
from annotator.workflows.workbench.refit import FoundBox, find_box, next_unlabelled, place_box, place_on_ground, refit
from annotator.workflows.workbench.review_queue import Order
from annotator.workflows.workbench.review_queue import queue as all_items
from annotator.workflows.workbench.save_object import ObjectDrawn, copy_boxes, save_object

router = APIRouter(tags=["review"])


class OrthoIn(Schema):
    """A box, and the size of its views."""

    box: Box3DJson
    size_px: Annotated[int, Field(ge=32, le=1024)] = 320


class OrthoView(ViewJson):
    """A view along an axis of the box: from above, from its front, or of its right side."""

    name: Literal["top", "front", "side"]


class RefitIn(Schema):
    """A box and its class."""

    box: Box3DJson
    label: ClassName


class FitOut(Schema):
    """A fitted box; if no object was found in an image box, `box` is null and `note` is the reason.

    `measured_by` names the detector that looked for it; `suggestion` is what a label made from it records. With
    `too_few_points`, it cannot be drawn by hand on views either; a box is then placed by its size alone.
    """

    box: Box3DJson | None
    outline: Outline
    points: int
    score: float | None
    quality: QualityJson | None
    measured_by: str | None
    suggestion: Suggestion | None
    note: str | None
    too_few_points: bool


@router.post("/api/projects/{name}/frames/{frame_id}/ortho")
def ortho(at: AtFrame, body: OrthoIn) -> list[OrthoView]:
    """Three views along the box's axes; points outside the box are dimmed."""
    drawn = ortho_views(at.open(), body.box.box(), body.size_px)
    return [OrthoView(name=name, **dict(drawn_view(at, view, encoded_image(view.rgb)))) for name, view in drawn.items()]


@router.post("/api/projects/{name}/frames/{frame_id}/refit")
def refit_box(at: AtFrame, body: RefitIn) -> FitOut:
    """Refit a box, starting from its present pose. Nothing is stored."""
    opened, config, ready = _ready(at)
    return _fitted(at, refit(opened, body.box.box(), body.label, config, ready.detector, ready.problem), ready)


@router.post("/api/projects/{name}/frames/{frame_id}/fit")
def fit(at: AtFrame, body: ImageBoxIn) -> FitOut:
    """Find the object in an image box; where it has hardly any points, place it by its size. Nothing is stored."""
    opened, config, ready = _ready(at)
    found = find_box(opened, body.image_box.box(), config, ready.detector, ready.problem)
    if found.too_few_points:
        found = place_box(opened, body.image_box.box(), config)
    return _fitted(at, found, ready)


class PlaceIn(Schema):
    """A point (camera frame, metres) above or below which an object of a class stands."""

    point: Vector3
    label: ClassName


@router.post("/api/projects/{name}/frames/{frame_id}/place")
def place(at: AtFrame, body: PlaceIn) -> FitOut:
    """Place a box of the class's typical size on the ground, turned like what stands there. Nothing is stored."""
    opened, config, ready = _ready(at)
    return _fitted(at, place_on_ground(opened, np.array(body.point), body.label, config, ready.detector), ready)


class UnlabelledIn(Schema):
    """The distance of the last thing that was offered, metres."""

    beyond: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 0.0


class UnlabelledOut(FitOut):
    """A box, the class that its thing seems to have (null if none has a usual size), and how far away it is, metres."""

    label: str | None
    distance: float


@router.post("/api/projects/{name}/frames/{frame_id}/unlabelled")
def unlabelled(at: AtFrame, body: UnlabelledIn) -> UnlabelledOut:
    """Box the next thing that this camera sees and that is in no box, the nearest first. Nothing is stored."""
    opened, config, _ = _ready(at)
    boxes = [each.box for each in at.project.labels.of_frame(at.frame_id) if each.state is not ReviewState.REJECTED]
    found, label, distance_m = next_unlabelled(opened, boxes, body.beyond, at.project.config.classes, config)
    return UnlabelledOut.of(_fitted(at, found, Readiness("none")), label=label, distance=distance_m)


def _fitted(at: InFrame, found: FoundBox, ready: Readiness) -> FitOut:
    measuring = None if found.too_few_points else ready.detector
    return FitOut.of(
        found,
        box=None if found.box is None else Box3DJson.of(found.box),
        outline=found.outline.round(2).tolist(),
        quality=QualityJson.of(found.quality),
        measured_by=None if measuring is None else measuring.title,
        suggestion=None if measuring is None else measuring.suggestion,
        note=at.ctx.public(found.note),
    )


def _ready(at: InFrame) -> tuple[OpenFrame, RcvConfig, Readiness]:
    """A frame, the recursion's settings for it, and the state of the project's view detector."""
    opened, project = at.open(), at.project
    ready = at.ctx.caches.detectors.readiness(project, DetectorKind.VIEW)
    drawn = project.boxes.on_image(at.frame_id)
    image_kind = BoxKind.BOX if drawn is None else drawn.box_kind
    return opened, frame_config(project, opened.frame, ready.detector, image_kind=image_kind), ready


@router.post("/api/projects/{name}/frames/{frame_id}/copy", responses=STALE)
def copy(at: AtFrame, body: FrameChange) -> FrameStateJson:
    """Copy the reviewed boxes of the previous frame, except those that this frame already has."""
    with at.change(body):
        copy_boxes(at.project, at.frame_id, None, body.context(at.operator))
    return at.state()


# The page requests the queue again long before it has shown this many items.
MOST_ITEMS = 500
ValueText = Annotated[str | None, Query(max_length=1000)]
Bound = Annotated[float | None, Query(allow_inf_nan=False)]
SourceName = Annotated[str, Query(min_length=1, max_length=MOST_NAME)]


class ItemJson(Schema):
    """A proposal to review, or (uid null) a frame to draw on; `sources` are all that see the object, `heading` is a
    unit vector in the frame of its camera, `number` is that of the frame, from 1."""

    frame: int
    number: int
    key: str
    recording: int
    uid: str | None
    label: str | None
    doubt: float | None
    sources: tuple[str, ...]
    heading: tuple[float, ...] | None


class QueueOut(Schema):
    """The first items, and the total number."""

    items: list[ItemJson]
    remaining: int


@router.get("/api/projects/{name}/queue")
def queue(
    at: AtProject,
    order: Order = Order.WORST,
    label: ClassName | None = None,
    attribute: ClassName | None = None,
    value: ValueText = None,
    contains: ValueText = None,
    low: Bound = None,
    high: Bound = None,
    known: bool = False,
    source: SourceName | None = None,
) -> QueueOut:
    """Proposals to review, or the frames whose labels would improve the detectors most.

    `attribute` is one of boxes, tracks or frames: those with this `value`, with one that `contains` a text, or from
    `low` to `high`; with any value (`known`), or without one. `source`: those of objects that it sees.
    """
    wanted = None
    if attribute is not None:
        of_frame = next(
            (each for each in at.project.config.attributes if each.name == attribute and each.of is AttributeOf.FRAME),
            None,
        )
        usual = None if of_frame is None else of_frame.default
        wanted = ValueFilter(attribute, of_frame is not None, usual, known, value, contains, low, high)
    queued = all_items(at.project, order, label, wanted, source, MOST_ITEMS)
    numbers = at.project.frames.numbers({item.frame.id for item in queued.items})
    items = [
        ItemJson.of(item, frame=frame.id, number=numbers[frame.id], key=frame.key, recording=frame.recording_id)
        for item, frame in ((item, item.frame) for item in queued.items)
    ]
    return QueueOut(items=items, remaining=queued.total)


@router.get("/api/projects/{name}/queue/sources")
def sources(at: AtProject) -> dict[str, int]:
    """The number of objects that each source sees among the proposals to review; "annotator" for our own."""
    return waiting_sources(at.project.store)


# Time limit for counting points; the next request counts those of further frames.
READING_S = 3.0


@router.get("/api/projects/{name}/statistics")
def statistics(at: AtProject) -> ReportedStatistics:
    """The same numbers as `annotator stats --json`."""
    return reported_statistics(at.project)


@router.get("/api/projects/{name}/checks")
def checks(at: AtProject) -> CheckReport:
    """Warnings about labels."""
    report = check_project(at.project, budget_s=READING_S)
    return report.model_copy(update={"unreadable": tuple(map(at.ctx.public_message, report.unreadable))})


# Maximum time to wait for a detector that is being loaded, since the page waits for the views.
LOADING_WAIT_S = 0.1

ViewBoxesIn = Annotated[list[Box2DJson | None], Field(max_length=4)]


class DrawnIn(ImageBoxIn):
    """An object with the boxes drawn so far, and the planes of the views on which they were drawn."""

    boxes: ViewBoxesIn
    planes: Planes = ()


class StepsIn(DrawnIn):
    """An object with the boxes drawn so far, and what they measure. `suggest`: also suggest the others."""

    box_kind: BoxKind = BoxKind.SILHOUETTE
    suggest: bool = True


class StepJson(Schema):
    """The front and side view of a step, the boxes drawn there, and those suggested where none is drawn."""

    views: list[ViewJson]
    drawn: list[Box2DJson | None]
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
    drawn = [None if box is None else box.box() for box in body.boxes]
    planes = [None if plane is None else plane.geometry() for plane in body.planes]
    return label_object(at.project, opened, body.image_box.box(), drawn, kind, planes, detector), ready


def _steps_json(at: InFrame, opened: OpenFrame, labelling: Labelling, ready: Readiness) -> StepsOut:
    detector, size = ready.detector, VIEWS_PER_STEP
    return StepsOut(
        steps=[
            StepJson(
                views=[drawn_view(at, view, opened.picture(view)) for view in step.views],
                drawn=_boxes_json(labelling.drawn[size * number : size * (number + 1)]),
                suggested=_boxes_json(step.suggested),
            )
            for number, step in enumerate(labelling.steps)
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


def _boxes_json(boxes: Sequence[Box2D | None]) -> list[Box2DJson | None]:
    return [None if box is None else Box2DJson.of(box) for box in boxes]


@router.post("/api/projects/{name}/frames/{frame_id}/label/whole")
def whole(at: AtFrame, body: ImageBoxIn) -> list[WholeBoxJson]:
    """The whole boxes that are offered for an object whose silhouettes are drawn, best first. Nothing is stored."""
    frame, caches = at.open().frame, at.ctx.caches
    detector = caches.detectors.readiness(at.project, DetectorKind.VIEW, LOADING_WAIT_S).detector
    stored = at.project.frames.get(at.frame_id)
    offers = caches.whole_boxes(at.project).of(frame, stored, body.image_box.box(), detector)
    outlines = visible_edges(frame.camera, [offer.box for offer in offers])
    return [
        WholeBoxJson(box=Box3DJson.of(offer.box), outline=outline.round(2).tolist())
        for offer, outline in zip(offers, outlines, strict=True)
    ]


@router.get("/api/projects/{name}/frames/{frame_id}/label/suggestions", response_model_exclude_none=True)
def suggestions(at: AtFrame) -> SuggestionsOut:
    """Boxes that the image detector suggests."""
    ready = at.ctx.caches.detectors.readiness(at.project, DetectorKind.IMAGE)
    if ready.detector is None:
        return SuggestionsOut(boxes=[], problem=at.ctx.public(ready.problem))
    opened = at.open()
    min_score = frame_config(at.project, opened.frame).min_image_score
    classes = at.project.config.classes
    detector = ready.detector
    found = opened.once(("image", detector.fingerprint), lambda: detector.detect([opened.frame])[0])
    kept = [box for box in found if box.score >= min_score and box.label in classes]
    return SuggestionsOut(boxes=[Box2DJson.of(box) for box in kept])


@router.post("/api/projects/{name}/frames/{frame_id}/label/object", responses=STALE)
def save(at: AtFrame, body: SaveIn) -> SaveOut:
    """Store the drawn boxes and suggest the others; an object with all four boxes on its views becomes a label."""
    opened, given = at.open(), body.object
    drawn = answer = None
    if given is not None:
        labelling, ready = _labelled(at, opened, given, body.box_kind)
        drawn = ObjectDrawn(given.image_box.box(), labelling, given.uid, given.suggestion)
        answer = _steps_json(at, opened, labelling, ready)
    with at.change(body):
        image_boxes, context = [box.box() for box in body.image_boxes], body.context(at.operator, body.subject)
        uid = save_object(at.project, at.frame_id, opened, image_boxes, body.box_kind, drawn, context, at.recording)
    return SaveOut.model_construct(state=at.state(), uid=uid, drawn=answer)
