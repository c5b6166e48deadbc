"""Review mode: views along a box's axes, refitting a box, fitting a box to an image box, copying boxes."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query
from pydantic import Field

from annotator.project.boxes import png
from annotator.project.classes.attributes import AttributeOf
from annotator.project.review import ValueFilter, waiting_sources
from annotator.rcv.config import RcvConfig
from annotator.types import BoxKind, DetectorKind, Suggestion
from annotator.web.context import AtProject
from annotator.web.frame_json import STALE, AtFrame, InFrame, drawn_view
from annotator.web.schemas import (
    Box3DJson,
    ClassName,
    FrameChange,
    FrameStateJson,
    ImageBoxIn,
    Outline,
    QualityJson,
    RowId,
    Schema,
    ViewJson,
)
from annotator.workflows.checking.project_labels import CheckReport, check_project
from annotator.workflows.detectors import ReportedStatistics, reported_statistics
from annotator.workflows.importing.boxes_3d import MOST_NAME
from annotator.workflows.workbench.contact_sheet import ortho_views
from annotator.workflows.workbench.drawing_steps import frame_config
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.loaded_detectors import Readiness
from annotator.workflows.workbench.refit import FoundBox, find_box, refit
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


class FitOut(Schema):
    """A fitted box; if no object was found in an image box, `box` is null and `note` is the reason.

    `measured_by` names the detector that looked for it; `suggestion` is what a label made from it records. With
    `too_few_points`, it cannot be drawn by hand on views either.
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


class CopyIn(FrameChange):
    """The frame to copy from; null = the previous one."""

    source: Annotated[RowId | None, Field(alias="from")] = None


@router.post("/api/projects/{name}/frames/{frame_id}/ortho")
def ortho(at: AtFrame, body: OrthoIn) -> OrthoOut:
    """Three views along the box's axes; points outside the box are dimmed."""
    drawn = ortho_views(at.open(), body.box.box(), body.size_px)
    views = [OrthoView(name=item.name, **dict(drawn_view(at, item.view, png(item.view.rgb)))) for item in drawn]
    return OrthoOut(views=views)


@router.post("/api/projects/{name}/frames/{frame_id}/refit")
def refit_box(at: AtFrame, body: RefitIn) -> FitOut:
    """Refit a box, starting from its present pose. Nothing is stored."""
    opened, config, ready = _ready(at)
    return _fitted(at, refit(opened, body.box.box(), body.label, config, ready.detector, ready.problem), ready)


@router.post("/api/projects/{name}/frames/{frame_id}/fit")
def fit(at: AtFrame, body: ImageBoxIn) -> FitOut:
    """Find the object in an image box. Nothing is stored."""
    opened, config, ready = _ready(at)
    return _fitted(at, find_box(opened, body.image_box.box(), config, ready.detector, ready.problem), ready)


def _fitted(at: InFrame, found: FoundBox, ready: Readiness) -> FitOut:
    return FitOut.of(
        found,
        box=None if found.box is None else Box3DJson.of(found.box),
        outline=found.outline.round(2).tolist(),
        quality=QualityJson.of(found.quality),
        measured_by=None if ready.detector is None else ready.detector.title,
        suggestion=None if ready.detector is None else ready.detector.suggestion,
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
def copy(at: AtFrame, body: CopyIn) -> FrameStateJson:
    """Copy the reviewed boxes of another frame, except those that this frame already has."""
    with at.change(body) as changed:
        receipt = copy_boxes(at.project, at.frame_id, body.source, body.context(at.operator))
        changed.append((at.frame_id, receipt))
    return at.state()


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
    sources: tuple[str, ...]


class QueueOut(Schema):
    """The first items, and the total number."""

    items: list[ItemJson]
    remaining: int


@router.get("/api/projects/{name}/queue")
def queue(
    at: AtProject,
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
    wanted = None
    if attribute is not None:
        of_frame = next(
            (each for each in at.project.config.attributes if each.name == attribute and each.of is AttributeOf.FRAME),
            None,
        )
        usual = None if of_frame is None else of_frame.default
        wanted = ValueFilter(attribute, of_frame is not None, usual, known, value, contains, low, high)
    queued = all_items(at.project, order, recording, label, wanted, source, limit)
    items = [
        ItemJson.of(item, frame=item.frame.id, key=item.frame.key, recording=item.frame.recording_id)
        for item in queued.items
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
def checks(at: AtProject, frame: RowId | None = None) -> CheckReport:
    """Warnings about labels, of one frame or of all."""
    report = check_project(at.project, frame, READING_S)
    return report.model_copy(update={"unreadable": tuple(map(at.ctx.public_message, report.unreadable))})
