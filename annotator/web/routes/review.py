"""Review mode: views along a box's axes, refitting a box, fitting a box to an image box, copying boxes."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query
from pydantic import Field

from annotator.project.boxes import png
from annotator.project.classes.attributes import AttributeOf
from annotator.project.review import ValueFilter
from annotator.rcv.config import RcvConfig
from annotator.types import BoxKind, DetectorKind
from annotator.web.context import Context, Ctx, Operator
from annotator.web.frame_json import STALE, both_versions, drawn_view, frame_state
from annotator.web.schemas import (
    Box3DJson,
    Box3DOut,
    ClassName,
    FrameChange,
    FrameStateJson,
    ImageBoxIn,
    Outline,
    QualityJson,
    RowId,
    Schema,
    SuggestionJson,
    ViewJson,
)
from annotator.workflows.checking.project_labels import CheckReport, check_project
from annotator.workflows.detectors import ReportedStatistics, reported_statistics
from annotator.workflows.importing.boxes_3d import MOST_NAME
from annotator.workflows.workbench.contact_sheet import ortho_views
from annotator.workflows.workbench.drawing_steps import frame_config
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.loaded_detectors import Readiness
from annotator.workflows.workbench.refit import RCV, find_box, refit
from annotator.workflows.workbench.review_queue import Order
from annotator.workflows.workbench.review_queue import queue as all_items
from annotator.workflows.workbench.save_object import copy_boxes

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


class CopyIn(FrameChange):
    """The frame to copy from; null = the previous one."""

    source: Annotated[RowId | None, Field(alias="from")] = None


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
        quality=QualityJson.of(fitted.quality),
        method=fitted.method,
        measured_by=ready.detector.title if ready.detector is not None and fitted.method == RCV else None,
        note=None if fitted.note is None else ctx.public_message(fitted.note),
    )


@router.post("/api/projects/{name}/frames/{frame_id}/fit")
def fit(ctx: Ctx, operator: Operator, name: str, frame_id: RowId, body: ImageBoxIn) -> FitOut:
    """Find the object in an image box. Nothing is stored."""
    opened, config, ready = _ready(ctx, name, frame_id, operator)
    fitted = find_box(opened, body.image_box.box(), config, ready.detector, ready.problem)
    return FitOut(
        box=None if fitted.box is None else Box3DOut.of(fitted.box),
        outline=fitted.outline.round(2).tolist(),
        points=fitted.points,
        score=fitted.score,
        quality=QualityJson.of(fitted.quality),
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


@router.post("/api/projects/{name}/frames/{frame_id}/copy", responses=STALE)
def copy(ctx: Ctx, operator: Operator, name: str, frame_id: RowId, body: CopyIn) -> FrameStateJson:
    """Copy the reviewed boxes of another frame, except those that this frame already has."""
    project = ctx.project(name)
    with both_versions(ctx, name, frame_id, operator, body):
        receipt = copy_boxes(project, frame_id, body.source, body.context(operator))
    ctx.hub.frame_changed(project, frame_id, receipt.revision, operator)
    return frame_state(ctx, name, frame_id, operator)


# The page requests the queue again long before it has shown this many items.
MOST_ITEMS = 500
ValueText = Annotated[str | None, Query(max_length=1000)]
Bound = Annotated[float | None, Query(allow_inf_nan=False)]
SourceName = Annotated[str, Query(min_length=1, max_length=MOST_NAME)]


class ItemJson(Schema):
    """A proposal to review, or (uid null) a frame to draw on; `sources` are all that see the object."""

    frame: int
    key: str
    recording: int
    uid: str | None
    label: str | None
    doubt: float | None
    sources: list[str]


class QueueOut(Schema):
    """The first items, and the total number."""

    items: list[ItemJson]
    remaining: int


@router.get("/api/projects/{name}/queue")
def queue(
    ctx: Ctx,
    name: str,
    order: Order = Order.WORST,
    recording: RowId | None = None,
    label: ClassName | None = None,
    attribute: ClassName | None = None,
    value: ValueText = None,
    contains: ValueText = None,
    low: Bound = None,
    high: Bound = None,
    known: bool = False,
    source: SourceName | None = None,
    limit: Annotated[int, Query(ge=1, le=MOST_ITEMS)] = MOST_ITEMS,
) -> QueueOut:
    """Proposals to review, or the frames whose labels would improve the detectors most.

    `attribute` is one of boxes, tracks or frames: those with this `value`, with one that `contains` a text, or from
    `low` to `high`; with any value (`known`), or without one. `source`: those of objects that it sees.
    """
    project = ctx.project(name)
    wanted = None
    if attribute is not None:
        of_frame = {each.name: each for each in project.config.attributes if each.of is AttributeOf.FRAME}.get(
            attribute
        )
        usual = None if of_frame is None else of_frame.default
        wanted = ValueFilter(attribute, of_frame is not None, usual, known, value, contains, low, high)
    queued = all_items(project, order, recording, label, wanted, source, limit)
    items = [
        ItemJson(
            frame=item.frame.id,
            key=item.frame.key,
            recording=item.frame.recording_id,
            uid=item.uid,
            label=item.label,
            doubt=item.doubt,
            sources=list(item.sources),
        )
        for item in queued.items
    ]
    return QueueOut(items=items, remaining=queued.total)


@router.get("/api/projects/{name}/queue/sources")
def sources(ctx: Ctx, name: str) -> dict[str, int]:
    """The number of objects that each source sees among the proposals to review; "annotator" for our own."""
    return ctx.project(name).labels.waiting_sources()


# Time limit for counting points; the next request counts those of further frames.
READING_S = 3.0


@router.get("/api/projects/{name}/statistics")
def statistics(ctx: Ctx, name: str) -> ReportedStatistics:
    """The same numbers as `annotator stats --json`."""
    return reported_statistics(ctx.project(name))


@router.get("/api/projects/{name}/checks")
def checks(ctx: Ctx, name: str, frame: RowId | None = None) -> CheckReport:
    """Warnings about labels, of one frame or of all."""
    report = check_project(ctx.project(name), frame, READING_S)
    return report.model_copy(update={"unreadable": tuple(map(ctx.public_message, report.unreadable))})
