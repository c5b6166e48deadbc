"""Tracks: the boxes of one object, following objects into the next frame, and interpolation between key frames."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal

from fastapi import APIRouter, Path
from fastapi.responses import JSONResponse

from annotator.project import Project, StoredFrame
from annotator.types import DetectorKind, ReviewState
from annotator.types.errors import StaleRevisionError
from annotator.web.context import Context, Ctx, Operator
from annotator.web.frame_json import frame_state, stale_response
from annotator.web.routes.frames import STALE
from annotator.web.schemas import Effort, FrameStateJson, RowId, Schema, Uid
from annotator.workflows.detectors import Detectors
from annotator.workflows.tracks.fit_boxes import FitBox, box_fitter
from annotator.workflows.tracks.follow import copy_next, propose_next
from annotator.workflows.tracks.interpolate import interpolate_back
from annotator.workflows.tracks.previous_boxes import boxes_of
from annotator.workflows.workbench.open_frame import OpenFrame

router = APIRouter(tags=["tracks"])

TrackId = Annotated[int, Path(ge=-(2**53), le=2**53)]


class TrackBox(Schema):
    """One box of an object."""

    frame: int
    key: str
    index: int | None
    uid: str
    state: ReviewState


class TrackOut(Schema):
    """All boxes of an object, in the order of the recording."""

    boxes: list[TrackBox]


class FollowIn(Schema):
    """Proposes this frame's objects in the next frame: `detect` searches for them, `copy` copies their boxes.

    Without detectors, boxes are always copied. `uid`: copy this label only.
    """

    revision: RowId
    how: Literal["detect", "copy"]
    uid: Uid | None = None
    effort: Effort | None = None


class FollowOut(Schema):
    """The next frame, the number of proposals, the method used, and the number of objects not found (`lost`)."""

    frame: int
    proposed: int
    lost: int
    how: Literal["detect", "copy"]


class InterpolateIn(Schema):
    """A reviewed label; proposals fill the frames back to its track's previous key frame. `refit`: refit each box."""

    revision: RowId
    uid: Uid
    refit: bool = False
    effort: Effort | None = None


class InterpolateOut(Schema):
    """Numbers of filled and skipped (finalised, covered) frames, and the present state of the frame."""

    filled: int
    finalised: int
    covered: int
    state: FrameStateJson


@router.get("/api/projects/{name}/recordings/{recording_id}/tracks/{track_id}")
def track(ctx: Ctx, name: str, recording_id: RowId, track_id: TrackId) -> TrackOut:
    """All boxes of an object."""
    boxes = boxes_of(ctx.project(name), recording_id, track_id)
    return TrackOut(
        boxes=[
            TrackBox(frame=frame.id, key=frame.key, index=frame.index, uid=label.uid, state=label.state)
            for frame, label in boxes
        ]
    )


@router.post("/api/projects/{name}/frames/{frame_id}/follow", response_model=FollowOut, responses=STALE)
def follow(ctx: Ctx, operator: Operator, name: str, frame_id: RowId, body: FollowIn) -> FollowOut | JSONResponse:
    """Propose boxes in the next frame from the reviewed boxes of this one; one undo step."""
    project = ctx.project(name)
    effort = None if body.effort is None else body.effort.stored()
    open_frame = _opener(ctx, project, operator)
    detectors = _detectors(ctx, project) if body.how == "detect" else None
    try:
        if detectors is None:
            fit = _box_fitter(ctx, project, open_frame)
            done = copy_next(project, frame_id, body.revision, operator, uid=body.uid, fit=fit, effort=effort)
        else:
            done = propose_next(project, frame_id, body.revision, operator, detectors, open_frame, effort=effort)
    except StaleRevisionError as error:
        return stale_response(ctx, name, frame_id, operator, error, [body.model_dump(mode="json")])
    for changed, receipt in done.changed:
        ctx.hub.frame_changed(name, changed, receipt.revision, operator)
    how: Literal["detect", "copy"] = "copy" if detectors is None else "detect"
    return FollowOut(frame=done.frame_id, proposed=done.proposed, lost=done.lost, how=how)


@router.post("/api/projects/{name}/frames/{frame_id}/interpolate", response_model=InterpolateOut, responses=STALE)
def interpolate(
    ctx: Ctx, operator: Operator, name: str, frame_id: RowId, body: InterpolateIn
) -> InterpolateOut | JSONResponse:
    """Propose boxes between a reviewed box and its track's previous reviewed box; one undo step."""
    project = ctx.project(name)
    effort = None if body.effort is None else body.effort.stored()
    fit = _box_fitter(ctx, project, _opener(ctx, project, operator)) if body.refit else None
    try:
        done = interpolate_back(project, frame_id, body.uid, body.revision, operator, fit=fit, effort=effort)
    except StaleRevisionError as error:
        return stale_response(ctx, name, frame_id, operator, error, [body.model_dump(mode="json")])
    for changed, receipt in done.filled:
        ctx.hub.frame_changed(name, changed, receipt.revision, operator)
    state = frame_state(ctx, name, frame_id, operator)
    return InterpolateOut.model_construct(
        filled=len(done.filled), finalised=done.finalised, covered=done.covered, state=state
    )


def _opener(ctx: Context, project: Project, operator: str) -> Callable[[StoredFrame], OpenFrame]:
    return lambda frame: ctx.caches.frames.open(project, frame.id, operator)


def _detectors(ctx: Context, project: Project) -> Detectors | None:
    """Both detectors, or None if the project lacks one."""
    image, view = (ctx.caches.detectors.get(project, role) for role in (DetectorKind.IMAGE, DetectorKind.VIEW))
    return None if image is None or view is None else Detectors(image, view, view.box_kind, view.class_agnostic)


def _box_fitter(ctx: Context, project: Project, open_frame: Callable[[StoredFrame], OpenFrame]) -> FitBox:
    view = ctx.caches.detectors.get(project, DetectorKind.VIEW)
    return box_fitter(project, open_frame, view)
