"""Frames: the list, one frame's state, and changes to it."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Query
from fastapi.responses import JSONResponse

from annotator.project.overview import list_frames
from annotator.types.errors import StaleRevisionError
from annotator.web.answers import frame_answer, stale_answer
from annotator.web.context import Ctx, Operator
from annotator.web.frame_changes import ChangesIn
from annotator.web.shown import frame_row
from annotator.web.wire import FrameListJson, FrameStateJson, RowId
from annotator.workflows.changes import apply_changes

router = APIRouter(tags=["frames"])

STALE: dict[int | str, dict[str, Any]] = {409: {"description": "somebody changed the frame first: both versions"}}


@router.get("/api/projects/{name}/frames")
def frames(
    ctx: Ctx,
    name: str,
    recording: RowId | None = None,
    offset: RowId = 0,
    limit: Annotated[int, Query(ge=1, le=1000)] = 200,
) -> FrameListJson:
    """A part of the list of frames, in order."""
    rows, total = list_frames(ctx.project(name), recording, offset, limit)
    return FrameListJson(frames=[frame_row(row) for row in rows], total=total)


@router.get("/api/projects/{name}/frames/{frame_id}", response_model=FrameStateJson)
def frame(ctx: Ctx, who: Operator, name: str, frame_id: RowId) -> JSONResponse:
    """All that a page shows of a frame."""
    state = frame_answer(ctx, name, frame_id, who)
    ctx.annotation.detectors.warm(ctx.project(name))
    return state


@router.post("/api/projects/{name}/frames/{frame_id}/changes", response_model=FrameStateJson, responses=STALE)
def changes(ctx: Ctx, who: Operator, name: str, frame_id: RowId, body: ChangesIn) -> JSONResponse:
    """Changes to one frame: all of them, or none; one step for undo."""
    project = ctx.project(name)
    open_frame = partial(ctx.annotation.frames.open, project, frame_id)
    try:
        receipt = apply_changes(project, frame_id, body.payloads(), body.change(who), open_frame)
    except StaleRevisionError as error:
        return stale_answer(ctx, name, frame_id, who, error, body.model_dump(mode="json")["changes"])
    ctx.hub.frame_changed(name, frame_id, receipt.revision, who)
    return frame_answer(ctx, name, frame_id, who)
