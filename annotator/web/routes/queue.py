"""What to look at next."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query

from annotator.web.context import Ctx
from annotator.web.wire import ClassName, RowId, Wire
from annotator.workflows.queue import Order
from annotator.workflows.queue import queue as all_items

router = APIRouter(tags=["queue"])

# A page asks again long before it has gone through so many.
MOST_ITEMS = 500


class ItemJson(Wire):
    """A proposal to review, or (uid null) a frame to draw on."""

    frame: int
    key: str
    recording: int
    uid: str | None
    label: str | None
    doubt: float | None


class QueueOut(Wire):
    """The first items, and how many there are in all."""

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
    """Proposals to review, or frames whose labels would teach most."""
    found = all_items(ctx.project(name), order, recording, label)
    items = [
        ItemJson(
            frame=item.frame.id,
            key=item.frame.key,
            recording=item.frame.recording_id,
            uid=item.uid,
            label=item.label,
            doubt=item.doubt,
        )
        for item in found[:limit]
    ]
    return QueueOut(items=items, remaining=len(found))
