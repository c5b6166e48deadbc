"""Tracks: the boxes of one object, following objects through a recording, and interpolation between key frames."""

from __future__ import annotations

import asyncio
import base64
from collections import deque
from collections.abc import AsyncIterator, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Path
from fastapi.responses import StreamingResponse
from pydantic import Field

from annotator.project import Project, StoredFrame
from annotator.types import DetectorKind, Label, ReviewState
from annotator.types.errors import AnnotatorError, DetectionError
from annotator.web.context import Context, Ctx, Operator
from annotator.web.follow_runs import Direction, FollowRequest, FollowRunJson
from annotator.web.frame_json import STALE, both_versions, frame_state
from annotator.web.schemas import Box3DJson, FrameChange, FrameStateJson, RowId, Schema, Uid, WithEffort
from annotator.workflows.tracks.copy_next import carry_correction, copy_next
from annotator.workflows.tracks.follow_run import follow_from_frame
from annotator.workflows.tracks.interpolate import FitBox, box_fitter, interpolate_back
from annotator.workflows.tracks.propose_boxes import boxes_of
from annotator.workflows.workbench.contact_sheet import SeenBox, accept_boxes
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.loaded_detectors import ReadyDetector, has_view_with_classes

router = APIRouter(tags=["tracks"])

TrackId = Annotated[int, Path(ge=-(2**53), le=2**53)]


class TrackBox(Schema):
    """One box of an object; `revision` is that of its frame."""

    frame: int
    revision: int
    key: str
    index: int | None
    uid: str
    state: ReviewState


class TrackOut(Schema):
    """All boxes of an object, in the order of the recording."""

    boxes: list[TrackBox]


class CopyNextIn(FrameChange):
    """A label, reviewed or not."""

    uid: Uid


class CopyNextOut(Schema):
    """The next frame, and the copy there."""

    frame: int
    uid: str


class CarryIn(FrameChange):
    """A reviewed label, and its box before it was corrected."""

    uid: Uid
    was: Box3DJson


class CarryOut(Schema):
    """Number of proposals that were corrected alike."""

    changed: int


class FollowIn(FrameChange):
    """A reviewed label to follow; null = all reviewed labels of the frame."""

    uid: Uid | None = None
    direction: Direction = "forward"


class FollowOut(Schema):
    """The operator's latest run, or null."""

    run: FollowRunJson | None


class InterpolateIn(FrameChange):
    """A reviewed label; proposals fill the frames back to its track's previous key frame. `refit`: refit each box."""

    uid: Uid
    refit: bool = False


class InterpolateOut(Schema):
    """Numbers of filled and skipped (finalised, covered) frames, and the present state of the frame."""

    filled: int
    finalised: int
    covered: int
    state: FrameStateJson


@router.get("/api/projects/{name}/recordings/{recording_id}/tracks/{track_id}")
def track(ctx: Ctx, name: str, recording_id: RowId, track_id: TrackId) -> TrackOut:
    """All boxes of an object. The pictures of its contact sheet are drawn in the meantime."""
    project = ctx.project(name)
    boxes = boxes_of(project, recording_id, track_id)
    ctx.caches.sheets.prepare(project, recording_id, boxes)
    return TrackOut(
        boxes=[
            TrackBox(
                frame=frame.id,
                revision=frame.revision,
                key=frame.key,
                index=frame.index,
                uid=label.uid,
                state=label.state,
            )
            for frame, label in boxes
        ]
    )


@router.post("/api/projects/{name}/frames/{frame_id}/copy-next", responses=STALE)
def copy_to_next(ctx: Ctx, operator: Operator, name: str, frame_id: RowId, body: CopyNextIn) -> CopyNextOut:
    """Propose a box in the next frame, moved along its track; one undo step."""
    project = ctx.project(name)
    opened = _opener(ctx, project, operator)
    with both_versions(ctx, name, frame_id, operator, body):
        done = copy_next(
            project,
            frame_id,
            body.uid,
            body.revision,
            operator,
            read=lambda frame: opened(frame).frame,
            effort=body.stored_effort(),
        )
    ctx.hub.frames_changed(project, done.changed, operator)
    return CopyNextOut(frame=done.frame_id, uid=done.uid)


@router.post("/api/projects/{name}/frames/{frame_id}/carry", responses=STALE)
def carry(ctx: Ctx, operator: Operator, name: str, frame_id: RowId, body: CarryIn) -> CarryOut:
    """Correct the later proposals of a track like this box; one undo step."""
    project = ctx.project(name)
    with both_versions(ctx, name, frame_id, operator, body):
        was, effort = body.was.box(), body.stored_effort()
        done = carry_correction(project, frame_id, body.uid, body.revision, was, operator, effort=effort)
    ctx.hub.frames_changed(project, done, operator)
    return CarryOut(changed=len(done))


@router.post("/api/projects/{name}/frames/{frame_id}/follow", responses=STALE)
def follow(ctx: Ctx, operator: Operator, name: str, frame_id: RowId, body: FollowIn) -> FollowRunJson:
    """Follow reviewed boxes through the recording; one undo step. The operator's last run is stopped first."""
    project = ctx.project(name)
    view = _own_view(ctx, project)
    ctx.follow_runs.stop(project, operator)
    with both_versions(ctx, name, frame_id, operator, body):
        run = follow_from_frame(
            project,
            frame_id,
            body.revision,
            view,
            operator,
            uid=body.uid,
            forward=body.direction == "forward",
            effort=body.stored_effort(),
        )
    request = FollowRequest(run, frame_id, body.direction, view is not None)
    return ctx.follow_runs.start(project, operator, request)


@router.get("/api/projects/{name}/follow")
def follow_run(ctx: Ctx, operator: Operator, name: str) -> FollowOut:
    """The operator's latest run in this project."""
    return FollowOut(run=ctx.follow_runs.latest(ctx.project(name), operator))


@router.post("/api/projects/{name}/follow/stop")
def stop_following(ctx: Ctx, operator: Operator, name: str) -> FollowOut:
    """Stop the operator's run; the boxes found so far stay."""
    return FollowOut(run=ctx.follow_runs.stop(ctx.project(name), operator))


@router.post("/api/projects/{name}/frames/{frame_id}/interpolate", responses=STALE)
def interpolate(ctx: Ctx, operator: Operator, name: str, frame_id: RowId, body: InterpolateIn) -> InterpolateOut:
    """Propose boxes between a reviewed box and its track's previous reviewed box; one undo step."""
    project = ctx.project(name)
    fit = _box_fitter(ctx, project, _opener(ctx, project, operator)) if body.refit else None
    with both_versions(ctx, name, frame_id, operator, body):
        effort = body.stored_effort()
        done = interpolate_back(project, frame_id, body.uid, body.revision, operator, fit=fit, effort=effort)
    ctx.hub.frames_changed(project, done.filled, operator)
    state = frame_state(ctx, name, frame_id, operator)
    return InterpolateOut.model_construct(
        filled=len(done.filled), finalised=done.finalised, covered=done.covered, state=state
    )


def _opener(ctx: Context, project: Project, operator: str) -> Callable[[StoredFrame], OpenFrame]:
    return lambda frame: ctx.caches.frames.open(project, frame.id, operator)


def _own_view(ctx: Context, project: Project) -> ReadyDetector | None:
    """The project's own view detector, or None."""
    if not has_view_with_classes(project):
        return None
    ready = ctx.caches.detectors.readiness(project, DetectorKind.VIEW)
    if ready.problem is not None:
        raise DetectionError(f"the view detector cannot be used: {ready.problem}")
    return ready.detector


def _box_fitter(ctx: Context, project: Project, open_frame: Callable[[StoredFrame], OpenFrame]) -> FitBox:
    view = ctx.caches.detectors.get(project, DetectorKind.VIEW)
    return box_fitter(project, open_frame, view)


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


class AcceptIn(WithEffort):
    """The proposals that were not clicked out."""

    boxes: Annotated[list[SeenJson], Field(max_length=MOST_BOXES)]


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
    project = ctx.project(name)
    ctx.hub.frames_changed(project, accept_boxes(project, boxes, operator, body.stored_effort()), operator)
    return AcceptOut(accepted=len(boxes))
