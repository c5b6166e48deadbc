"""Contact sheets: small pictures of a track's boxes along their axes, and accepting proposals of several frames."""

from __future__ import annotations

import asyncio
import base64
from collections import deque
from collections.abc import AsyncIterator, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter
from fastapi.responses import StreamingResponse
from pydantic import Field

from annotator.project import Project, StoredFrame
from annotator.types import Label, ReviewState
from annotator.types.errors import AnnotatorError
from annotator.web.context import Context, Ctx, Operator
from annotator.web.routes.tracks import TrackId
from annotator.web.schemas import Effort, RowId, Schema, Uid
from annotator.workflows.tracks.previous_boxes import boxes_of
from annotator.workflows.workbench.contact_sheet import SeenBox, accept_boxes

router = APIRouter(tags=["tracks"])

# A sheet of so many boxes would be too long to look at.
MOST_BOXES = 2000
# One thread draws while the other one waits for the disk.
THREADS = 2
AHEAD = 2 * THREADS

Entry = TypeVar("Entry")


class TileJson(Schema):
    """A picture: top, front and right side of a box, as a PNG file in base64; or why it cannot be drawn."""

    uid: str
    png: str | None = None
    problem: str | None = None


class SeenJson(Schema):
    """A proposal on a sheet, and the revision of its frame that the sheet shows."""

    frame: RowId
    revision: RowId
    uid: Uid


class AcceptIn(Schema):
    """The proposals that were not clicked out."""

    boxes: Annotated[list[SeenJson], Field(max_length=MOST_BOXES)]
    effort: Effort | None = None


class AcceptOut(Schema):
    """Number of accepted proposals."""

    accepted: int


STREAM: dict[int | str, dict[str, Any]] = {200: {"model": TileJson}}


@router.get(
    "/api/projects/{name}/recordings/{recording_id}/tracks/{track_id}/sheet",
    response_class=StreamingResponse,
    responses=STREAM,
)
def track_sheet(ctx: Ctx, name: str, recording_id: RowId, track_id: TrackId) -> StreamingResponse:
    """The pictures of a track's boxes in its order, a line of JSON (`TileJson`) each, sent as soon as it is drawn."""
    project = ctx.project(name)
    return _tiles(ctx, project, boxes_of(project, recording_id, track_id))


@router.get("/api/projects/{name}/frames/{frame_id}/sheet", response_class=StreamingResponse, responses=STREAM)
def frame_sheet(ctx: Ctx, name: str, frame_id: RowId) -> StreamingResponse:
    """The pictures of a frame's boxes, as those of a track."""
    project = ctx.project(name)
    stored = project.frames.get(frame_id)
    return _tiles(ctx, project, [(stored, label) for label in project.labels.of_frame(frame_id)])


def _tiles(ctx: Context, project: Project, boxes: Sequence[tuple[StoredFrame, Label]]) -> StreamingResponse:
    shown = [(s, label) for s, label in boxes if s.index is not None and label.state is not ReviewState.REJECTED]

    def line(entry: tuple[StoredFrame, Label]) -> str:
        stored, label = entry
        try:
            content = ctx.caches.sheets.get(project, stored, label.box)
        except AnnotatorError as error:
            tile = TileJson(uid=label.uid, problem=ctx.public_message(str(error)))
        else:
            tile = TileJson(uid=label.uid, png=base64.b64encode(content).decode())
        return tile.model_dump_json() + "\n"

    async def lines() -> AsyncIterator[str]:
        with ctx.caches.detectors.holding_off():
            async for each in drawn_ahead(line, shown):
                yield each

    return StreamingResponse(lines(), media_type="application/x-ndjson")


async def drawn_ahead(draw: Callable[[Entry], str], entries: Sequence[Entry]) -> AsyncIterator[str]:
    """Yields what `draw` returns, in order; no more than `AHEAD` are drawn before they are asked for."""
    executor, waiting = ThreadPoolExecutor(THREADS, "sheet"), iter(entries)
    try:
        drawn = deque(executor.submit(draw, entry) for entry in islice(waiting, AHEAD))
        while drawn:
            line = await asyncio.wrap_future(drawn.popleft())
            drawn.extend(executor.submit(draw, entry) for entry in islice(waiting, 1))
            yield line
    finally:
        # also if the client has gone
        executor.shutdown(wait=False, cancel_futures=True)


@router.post("/api/projects/{name}/sheet/accept")
def accept(ctx: Ctx, operator: Operator, name: str, body: AcceptIn) -> AcceptOut:
    """Accept proposals in several frames, all or none, as one undo step."""
    boxes = [SeenBox(seen.frame, seen.revision, seen.uid) for seen in body.boxes]
    project, effort = ctx.project(name), None if body.effort is None else body.effort.stored()
    for frame, receipt in accept_boxes(project, boxes, operator, effort):
        ctx.hub.frame_changed(project, frame, receipt.revision, operator)
    return AcceptOut(accepted=len(boxes))
