"""Tracks: the boxes of one object, operations on them, and following objects through a recording."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from typing import Annotated, Any

from fastapi import APIRouter, Path
from fastapi.responses import Response, StreamingResponse
from pydantic import Field

from annotator.project import StoredFrame
from annotator.project.lanes import Lane, read_lanes
from annotator.project.overview import read_page
from annotator.types import DetectorKind, Label, ReviewState
from annotator.types.errors import AnnotatorError, DetectionError
from annotator.web.context import AtProject, InProject
from annotator.web.follow_runs import Direction, FollowRunJson
from annotator.web.frame_json import STALE, AtFrame, InFrame, ModelResponse, picture_version
from annotator.web.schemas import FrameChange, RowId, Schema, Uid, WithEffort
from annotator.workflows.tracks.copy_next import copy_next
from annotator.workflows.tracks.follow_run import follow_from_frame
from annotator.workflows.tracks.operations import AnyOperation, Fill, apply
from annotator.workflows.tracks.propose_boxes import boxes_of
from annotator.workflows.tracks.refit_run import RefitRun, box_fitter
from annotator.workflows.tracks.steps import Count
from annotator.workflows.workbench.contact_sheet import SeenBox, accept_boxes
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.frame_state import Sight, sights
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


class LabelIn(FrameChange):
    """A label."""

    uid: Uid


class LanesJson(Schema):
    """The timeline of a recording: the ids of its frames in order, and a lane for each track.

    `pictures` is the query with which browsers may cache small pictures of its frames.
    """

    recording: int
    frames: tuple[int, ...]
    lanes: tuple[Lane, ...]
    pictures: str


class CopyNextOut(Schema):
    """The next frame, and the copy there."""

    frame: int
    uid: str


class FollowIn(FrameChange):
    """A reviewed label to follow; null = all reviewed labels of the frame."""

    uid: Uid | None = None
    direction: Direction = "forward"


class OperationIn(WithEffort):
    """An operation on a track, the count that the operator was told, and the frame in which the operator is."""

    operation: AnyOperation
    told: Count | None = None
    at: RowId | None = None


class OperationOut(Schema):
    """What the operation does, also in words; and the operation to be sent with it, with the size that was fitted."""

    count: Count
    words: str
    operation: AnyOperation


@router.get("/api/projects/{name}/recordings/{recording_id}/tracks", response_model=LanesJson)
def tracks(at: AtProject, recording_id: RowId) -> Response:
    """All tracks of a recording, as its timeline shows them."""
    stored, lanes = at.project.recordings.get(recording_id), read_lanes(at.project.store, recording_id)
    found = LanesJson.model_construct(
        recording=recording_id,
        frames=lanes.frames,
        lanes=lanes.lanes,
        pictures=picture_version(at.project, recording_id, stored.name, "", stored.adjusted),
    )
    return ModelResponse(found)


@router.get("/api/projects/{name}/recordings/{recording_id}/tracks/{track_id}")
def track(at: AtProject, recording_id: RowId, track_id: TrackId) -> list[TrackBox]:
    """All boxes of an object, in the order of the recording. Its contact sheet is drawn in the meantime."""
    boxes = boxes_of(at.project, recording_id, track_id)
    at.ctx.caches.sheets.prepare(at.project, boxes)
    return [TrackBox.of(frame, frame=frame.id, uid=label.uid, state=label.state) for frame, label in boxes]


@router.post("/api/projects/{name}/frames/{frame_id}/copy-next", responses=STALE)
def copy_to_next(at: AtFrame, body: LabelIn) -> CopyNextOut:
    """Propose a box in the next frame, moved along its track; one undo step."""
    frames = at.ctx.caches.frames
    with at.change(body):
        done = copy_next(
            at.project,
            at.frame_id,
            body.uid,
            body.revision,
            at.operator,
            read=lambda frame: frames.read(at.project, frame.id),
            effort=body.stored_effort(),
        )
    return CopyNextOut(frame=done.frame_id, uid=done.uid)


@router.post("/api/projects/{name}/frames/{frame_id}/follow", responses=STALE)
def follow(at: AtFrame, body: FollowIn) -> FollowRunJson:
    """Follow reviewed boxes through the recording; one undo step. The operator's last run is stopped first."""
    view, runs = _own_view(at), at.ctx.follow_runs
    runs.stop(at.project, at.operator)
    with at.change(body):
        run = follow_from_frame(
            at.project,
            at.frame_id,
            body.revision,
            view,
            at.operator,
            uid=body.uid,
            forward=body.direction == "forward",
            effort=body.stored_effort(),
        )
    return runs.start(at.project, at.operator, run, at.frame_id, body.direction, view is not None)


@router.get("/api/projects/{name}/follow")
def follow_run(at: AtProject) -> FollowRunJson | None:
    """The operator's latest run in this project."""
    return at.ctx.follow_runs.latest(at.project, at.operator)


@router.post("/api/projects/{name}/follow/stop")
def stop_following(at: AtProject) -> FollowRunJson | None:
    """Stop the operator's run; the boxes found so far stay."""
    return at.ctx.follow_runs.stop(at.project, at.operator)


@router.post("/api/projects/{name}/recordings/{recording_id}/tracks/{track_id}")
def operate(at: AtProject, recording_id: RowId, track_id: TrackId, body: OperationIn) -> OperationOut:
    """Apply an operation to a track, one undo step, if it does what the operator was told; untold, only count."""
    caches, operation = at.ctx.caches, body.operation
    is_fit = isinstance(operation, Fill) and operation.refit
    if is_fit:
        at.ctx.follow_runs.require_none(at.project, at.operator)
    is_fit &= body.told is not None
    view = caches.detectors.get(at.project, DetectorKind.VIEW) if is_fit else None
    done = apply(
        at.project,
        recording_id,
        track_id,
        operation,
        at.operator,
        dry_run=body.told is None,
        told=body.told,
        effort=body.stored_effort(),
        at=body.at,
        recordings=at.recording,
    )
    if body.told is not None:
        at.announce()
    if is_fit:
        fit = box_fitter(at.project, lambda frame: OpenFrame(caches.frames.look(at.project, frame)), view)
        run = RefitRun(at.project, done, at.operator, fit)
        at.ctx.follow_runs.start(at.project, at.operator, run, done.changes[0][0], "between", view is not None)
    return OperationOut(count=done.count, words=done.count.words(), operation=done.operation)


def _own_view(at: InFrame) -> ReadyDetector | None:
    """The project's own view detector, or None."""
    if not has_view_with_classes(at.project):
        return None
    ready = at.ctx.caches.detectors.readiness(at.project, DetectorKind.VIEW)
    if ready.problem is not None:
        raise DetectionError(f"the view detector cannot be used: {ready.problem}")
    return ready.detector


# A sheet of so many boxes would be too long to look at.
MOST_BOXES = 2000


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


STREAM: dict[int | str, dict[str, Any]] = {200: {"model": TileJson}}


@router.get(
    "/api/projects/{name}/recordings/{recording_id}/tracks/{track_id}/sheet",
    response_class=StreamingResponse,
    responses=STREAM,
)
def track_sheet(at: AtProject, recording_id: RowId, track_id: TrackId) -> StreamingResponse:
    """The pictures of a track's boxes in its order, a line of JSON (`TileJson`) each, sent as soon as it is drawn."""
    return _tiles(at, boxes_of(at.project, recording_id, track_id))


@router.get("/api/projects/{name}/frames/{frame_id}/sheet", response_class=StreamingResponse, responses=STREAM)
def frame_sheet(at: AtFrame) -> StreamingResponse:
    """The pictures of a frame's boxes, as those of a track; without those that another camera sees better."""
    page = read_page(at.project, at.frame_id)
    seen = sights(at.project, at.ctx.caches.frames, page)
    labels = (stored.label for stored in page.labels)
    return _tiles(at, [(page.frame, one) for one in labels if seen.get(one.uid, Sight()).better is None])


def _tiles(at: InProject, boxes: Sequence[tuple[StoredFrame, Label]]) -> StreamingResponse:
    def lines() -> Iterator[str]:
        # Starlette draws one line after the other in a thread, and stops once the client has gone
        for stored, label in boxes:
            if stored.index is None or label.state is ReviewState.REJECTED:
                continue
            try:
                content = at.ctx.caches.sheets.get(at.project, stored, label.box)
            except AnnotatorError as error:
                tile = TileJson(uid=label.uid, problem=at.ctx.public_message(str(error)))
            else:
                tile = TileJson(uid=label.uid, png=base64.b64encode(content).decode())
            yield tile.model_dump_json() + "\n"

    return StreamingResponse(lines(), media_type="application/x-ndjson")


@router.post("/api/projects/{name}/sheet/accept", status_code=204)
def accept(at: AtProject, body: AcceptIn) -> None:
    """Accept proposals in several frames, all or none, as one undo step."""
    boxes = [SeenBox(seen.frame, seen.revision, seen.uid) for seen in body.boxes]
    accept_boxes(at.project, boxes, at.operator, body.stored_effort())
    at.announce()
