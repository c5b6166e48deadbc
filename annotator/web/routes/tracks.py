"""Objects over a recording: where one is, from one frame to the next, and between key frames."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal

from fastapi import APIRouter, Path
from fastapi.responses import JSONResponse

from annotator.project import Project, Role, StoredFrame
from annotator.types import BoxKind, ReviewState
from annotator.types.errors import StaleRevisionError
from annotator.web.answers import stale_answer
from annotator.web.context import Context, Ctx, Operator
from annotator.web.routes.frames import STALE
from annotator.web.shown import frame_state
from annotator.web.wire import Effort, FrameStateJson, RowId, Uid, Wire
from annotator.workflows.detectors import Detectors
from annotator.workflows.open_frame import OpenFrame
from annotator.workflows.tracks.boxes import boxes_of
from annotator.workflows.tracks.follow import copy_next, propose_next
from annotator.workflows.tracks.interpolate import interpolate_back
from annotator.workflows.tracks.snap import Snap, snapper

router = APIRouter(tags=["tracks"])

TrackId = Annotated[int, Path(ge=-(2**53), le=2**53)]


class TrackBox(Wire):
    """One box of an object."""

    frame: int
    key: str
    index: int | None
    uid: str
    state: ReviewState


class TrackOut(Wire):
    """All boxes of an object, in the order of the recording."""

    boxes: list[TrackBox]


class FollowIn(Wire):
    """From this frame to the next one: `detect` looks for its objects, `copy` carries its boxes over.

    Without detectors, boxes are copied in any case. `uid`: copy this label only.
    """

    revision: RowId
    how: Literal["detect", "copy"]
    uid: Uid | None = None
    effort: Effort | None = None


class FollowOut(Wire):
    """The next frame, what was proposed in it, and how; `lost` objects were not found again."""

    frame: int
    proposed: int
    lost: int
    how: Literal["detect", "copy"]


class InterpolateIn(Wire):
    """The reviewed label to fill the frames before, back to its track's last key frame; `refit` fits the boxes."""

    revision: RowId
    uid: Uid
    refit: bool = False
    effort: Effort | None = None


class InterpolateOut(Wire):
    """What was filled in, what was left alone, and the frame as it is now."""

    filled: int
    finalised: int
    covered: int
    state: FrameStateJson


@router.get("/api/projects/{name}/recordings/{recording_id}/tracks/{track_id}")
def track(ctx: Ctx, name: str, recording_id: RowId, track_id: TrackId) -> TrackOut:
    """All boxes of an object."""
    found = boxes_of(ctx.project(name), recording_id, track_id)
    return TrackOut(
        boxes=[
            TrackBox(frame=frame.id, key=frame.key, index=frame.index, uid=label.uid, state=label.state)
            for frame, label in found
        ]
    )


@router.post("/api/projects/{name}/frames/{frame_id}/follow", response_model=FollowOut, responses=STALE)
def follow(ctx: Ctx, who: Operator, name: str, frame_id: RowId, body: FollowIn) -> FollowOut | JSONResponse:
    """Proposals in the next frame, from the reviewed boxes of this one; one step for undo."""
    project = ctx.project(name)
    effort = None if body.effort is None else body.effort.stored()
    open_frame = _opener(ctx, project, who)
    detectors = _detectors(ctx, project) if body.how == "detect" else None
    try:
        if detectors is None:
            snap = _snap(ctx, project, open_frame)
            done = copy_next(project, frame_id, body.revision, who, uid=body.uid, snap=snap, effort=effort)
        else:
            done = propose_next(project, frame_id, body.revision, who, detectors, open_frame, effort=effort)
    except StaleRevisionError as error:
        return stale_answer(ctx, name, frame_id, who, error, [body.model_dump(mode="json")])
    for changed, receipt in done.changed:
        ctx.hub.frame_changed(name, changed, receipt.revision, who)
    how: Literal["detect", "copy"] = "copy" if detectors is None else "detect"
    return FollowOut(frame=done.frame_id, proposed=done.proposed, lost=done.lost, how=how)


@router.post("/api/projects/{name}/frames/{frame_id}/interpolate", response_model=InterpolateOut, responses=STALE)
def interpolate(
    ctx: Ctx, who: Operator, name: str, frame_id: RowId, body: InterpolateIn
) -> InterpolateOut | JSONResponse:
    """Proposals between a reviewed box and its track's reviewed box before; one step for undo."""
    project = ctx.project(name)
    effort = None if body.effort is None else body.effort.stored()
    snap = _snap(ctx, project, _opener(ctx, project, who)) if body.refit else None
    try:
        done = interpolate_back(project, frame_id, body.uid, body.revision, who, snap=snap, effort=effort)
    except StaleRevisionError as error:
        return stale_answer(ctx, name, frame_id, who, error, [body.model_dump(mode="json")])
    for changed, receipt in done.filled:
        ctx.hub.frame_changed(name, changed, receipt.revision, who)
    state = frame_state(ctx, name, frame_id, who)
    return InterpolateOut.model_construct(
        filled=len(done.filled), finalised=done.finalised, covered=done.covered, state=state
    )


def _opener(ctx: Context, project: Project, who: str) -> Callable[[StoredFrame], OpenFrame]:
    return lambda frame: ctx.annotation.frames.open(project, frame.id, who)


def _detectors(ctx: Context, project: Project) -> Detectors | None:
    """Both detectors, where the project has both."""
    image, view = (ctx.annotation.detectors.get(project, role) for role in (Role.IMAGE, Role.VIEW))
    return None if image is None or view is None else Detectors(image, view, view.box_kind)


def _snap(ctx: Context, project: Project, open_frame: Callable[[StoredFrame], OpenFrame]) -> Snap:
    view = ctx.annotation.detectors.get(project, Role.VIEW)
    return snapper(project, open_frame, view, BoxKind.BOX if view is None else view.box_kind)
