"""The queue of proposals to review, or frames to label."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query

from annotator.project.classes.attributes import AttributeOf
from annotator.project.review.value_filter import ValueFilter
from annotator.web.context import Ctx
from annotator.web.schemas import ClassName, RowId, Schema
from annotator.workflows.importing.proposals_3d import MOST_NAME
from annotator.workflows.workbench.review_queue import Order
from annotator.workflows.workbench.review_queue import queue as all_items

router = APIRouter(tags=["review"])

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
