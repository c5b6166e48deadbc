"""Undo and redo."""

from __future__ import annotations

from collections.abc import Callable

from fastapi import APIRouter
from fastapi.responses import JSONResponse

from annotator.project import Done, Project
from annotator.types.errors import HistoryError
from annotator.web.context import Context, Ctx, Operator
from annotator.web.errors import error_response
from annotator.web.routes.frames import STALE
from annotator.web.shown import frame_state
from annotator.web.wire import Effort, FrameStateJson, Wire

router = APIRouter(tags=["history"])


class StepIn(Wire):
    """`skip` passes over what somebody else has changed since."""

    skip: bool = False
    effort: Effort | None = None


class StepOut(Wire):
    """What was taken back or done again, where, and what is there now."""

    frame: int
    state: FrameStateJson
    done: str


@router.post("/api/projects/{name}/undo", response_model=StepOut, responses=STALE)
def undo(ctx: Ctx, who: Operator, name: str, body: StepIn) -> StepOut | JSONResponse:
    """Take back the operator's last action, wherever it was."""
    return _step(ctx, who, name, body, lambda project: project.history.undo)


@router.post("/api/projects/{name}/redo", response_model=StepOut, responses=STALE)
def redo(ctx: Ctx, who: Operator, name: str, body: StepIn) -> StepOut | JSONResponse:
    """Do again what was undone last."""
    return _step(ctx, who, name, body, lambda project: project.history.redo)


def _step(
    ctx: Context, who: str, name: str, body: StepIn, which: Callable[[Project], Callable[..., Done]]
) -> StepOut | JSONResponse:
    effort = None if body.effort is None else body.effort.stored()
    try:
        done = which(ctx.project(name))(who, skip=body.skip, effort=effort)
    except HistoryError as error:
        if error.frame_id is None:
            raise
        state = frame_state(ctx, name, error.frame_id, who).model_dump(mode="json")
        return error_response("HistoryError", str(error), 409, frame=error.frame_id, state=state)
    for frame_id, receipt in ((done.frame_id, done.receipt), *done.others):
        ctx.hub.frame_changed(name, frame_id, receipt.revision, who)
    return StepOut.model_construct(
        frame=done.frame_id, state=frame_state(ctx, name, done.frame_id, who), done=done.words
    )
