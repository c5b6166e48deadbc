"""The queue of proposals to review, or frames to label."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query

from annotator.web.context import Ctx
from annotator.web.schemas import ClassName, RowId, Schema
from annotator.workflows.workbench.review_queue import Order
from annotator.workflows.workbench.review_queue import queue as all_items

router = APIRouter(tags=["queue"])

# The page requests the queue again long before it has shown this many items.
MOST_ITEMS = 500


class ItemJson(Schema):
    """A proposal to review, or (uid null) a frame to draw on."""

    frame: int
    key: str
    recording: int
    uid: str | None
    label: str | None
    doubt: float | None


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
    limit: Annotated[int, Query(ge=1, le=MOST_ITEMS)] = MOST_ITEMS,
) -> QueueOut:
    """Proposals to review, or the frames whose labels would improve the detectors most."""
    queued = all_items(ctx.project(name), order, recording, label)
    items = [
        ItemJson(
            frame=item.frame.id,
            key=item.frame.key,
            recording=item.frame.recording_id,
            uid=item.uid,
            label=item.label,
            doubt=item.doubt,
        )
        for item in queued[:limit]
    ]
    return QueueOut(items=items, remaining=len(queued))
