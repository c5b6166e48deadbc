"""Frames: the list, the state of one frame, changes, undo and redo."""

from __future__ import annotations

import uuid
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Query
from fastapi.responses import JSONResponse, Response
from pydantic import Field

from annotator.project import Origin, Project, Reverted
from annotator.project.log.event_types import (
    FrameFinalised,
    FrameReopened,
    ImageBoxesSet,
    LabelAccepted,
    LabelCreated,
    LabelDeleted,
    LabelEdited,
    LabelRejected,
    LabelTracked,
    Payload,
)
from annotator.project.log.records import BoxRecord
from annotator.project.overview import list_frames
from annotator.types import BoxKind
from annotator.types.errors import HistoryError
from annotator.types.label import MOST_TRACK
from annotator.web.context import Context, Ctx, Operator
from annotator.web.errors import AnsweredError, error_response
from annotator.web.frame_json import STALE, both_versions, frame_response, frame_row, frame_state
from annotator.web.schemas import (
    MOST_BOXES,
    Box2DJson,
    Box3DJson,
    ClassName,
    FrameChange,
    FrameListJson,
    FrameStateJson,
    RowId,
    Schema,
    SuggestionJson,
    Uid,
    WithEffort,
)
from annotator.workflows.workbench.save_object import apply_changes

TrackId = Annotated[int, Field(ge=-MOST_TRACK, le=MOST_TRACK)]


class Accept(Schema):
    """Accepts a label unchanged."""

    kind: Literal["accept"]
    uid: Uid

    def payload(self) -> Payload:
        return LabelAccepted(uid=self.uid)


class Reject(Schema):
    """Rejects a label: the object does not exist."""

    kind: Literal["reject"]
    uid: Uid

    def payload(self) -> Payload:
        return LabelRejected(uid=self.uid)


class Delete(Schema):
    """Removes a label; the object may be proposed again."""

    kind: Literal["delete"]
    uid: Uid

    def payload(self) -> Payload:
        return LabelDeleted(uid=self.uid)


class Edit(Schema):
    """Changes a label's class, box and track; with `box_kind`, also what its box encloses."""

    kind: Literal["edit"]
    uid: Uid
    label: ClassName
    box: Box3DJson
    track_id: TrackId | None = None
    box_kind: BoxKind | None = None

    def payload(self) -> Payload:
        box = BoxRecord.of(self.box.box())
        return LabelEdited(uid=self.uid, label=self.label, box=box, track_id=self.track_id, box_kind=self.box_kind)


class Track(Schema):
    """Changes a label's track, or removes it from its track; its review state stays."""

    kind: Literal["track"]
    uid: Uid
    track_id: TrackId | None

    def payload(self) -> Payload:
        return LabelTracked(uid=self.uid, track_id=self.track_id)


class Create(Schema):
    """Creates an accepted label.

    `image_box` is the box on the image that it was fitted to, if any; `suggestion` the detector that fitted it.
    """

    kind: Literal["create"]
    label: ClassName
    box: Box3DJson
    track_id: TrackId | None = None
    image_box: Box2DJson | None = None
    suggestion: SuggestionJson | None = None

    def payload(self) -> Payload:
        return LabelCreated(
            uid=uuid.uuid4().hex,
            label=self.label,
            box=BoxRecord.of(self.box.box()),
            track_id=self.track_id,
            origin=Origin.PLACED if self.image_box is None else Origin.DRAWN,
            image_box=None if self.image_box is None else self.image_box.box(),
            suggestion=None if self.suggestion is None else self.suggestion.stored(),
        )


class ImageBoxesIn(Schema):
    """Replaces all boxes on the camera image."""

    kind: Literal["image_boxes"]
    boxes: Annotated[list[Box2DJson], Field(max_length=MOST_BOXES)]
    box_kind: BoxKind

    def payload(self) -> Payload:
        return ImageBoxesSet(boxes=tuple(box.box() for box in self.boxes), box_kind=self.box_kind)


class Finalise(Schema):
    """Finalises the frame."""

    kind: Literal["finalise"]

    def payload(self) -> Payload:
        return FrameFinalised()


class Reopen(Schema):
    """Reopens the frame."""

    kind: Literal["reopen"]

    def payload(self) -> Payload:
        return FrameReopened()


ChangeIn = Annotated[
    Accept | Reject | Delete | Edit | Track | Create | ImageBoxesIn | Finalise | Reopen, Field(discriminator="kind")
]


class ChangesIn(FrameChange):
    """Changes of one frame, based on one revision of it."""

    changes: Annotated[list[ChangeIn], Field(min_length=1, max_length=MOST_BOXES)]
    subject: Uid | None = None

    def payloads(self) -> list[Payload]:
        return [entry.payload() for entry in self.changes]

    def sent(self) -> list[Any]:
        changes: list[Any] = self.model_dump(mode="json")["changes"]
        return changes


router = APIRouter(tags=["frames"])


class StepIn(WithEffort):
    """`skip`: skip actions whose targets another operator has changed since."""

    skip: bool = False


class StepOut(Schema):
    """The undone or redone action (`done`, in words), its frame, and the frame's present state."""

    frame: int
    state: FrameStateJson
    done: str


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
def frame(ctx: Ctx, operator: Operator, name: str, frame_id: RowId) -> JSONResponse:
    """All data of a frame that the page shows."""
    return frame_response(ctx, name, frame_id, operator)


@router.post("/api/projects/{name}/frames/{frame_id}/changes", response_model=FrameStateJson, responses=STALE)
def changes(ctx: Ctx, operator: Operator, name: str, frame_id: RowId, body: ChangesIn) -> JSONResponse:
    """Change one frame: all changes or none, as one undo step."""
    project = ctx.project(name)
    open_frame = partial(ctx.caches.frames.open, project, frame_id)
    with both_versions(ctx, name, frame_id, operator, body):
        known = ctx.caches.frames.known_page(project, frame_id)
        context = body.context(operator, body.subject)
        receipt = apply_changes(project, frame_id, body.payloads(), context, open_frame, known)
    ctx.hub.frame_changed(project, frame_id, receipt.revision, operator)
    return frame_response(ctx, name, frame_id, operator)


@router.post("/api/projects/{name}/undo", responses=STALE)
def undo(ctx: Ctx, operator: Operator, name: str, body: StepIn) -> StepOut:
    """Undo the operator's last action, on whichever frame. A run that follows objects is stopped first.

    Refused while 2D boxes of a file are being stored for this operator.
    """
    return _step(ctx, operator, name, body, lambda project: project.history.undo)


@router.post("/api/projects/{name}/redo", responses=STALE)
def redo(ctx: Ctx, operator: Operator, name: str, body: StepIn) -> StepOut:
    """Redo the action that was undone last; otherwise as `undo`."""
    return _step(ctx, operator, name, body, lambda project: project.history.redo)


def _step(
    ctx: Context, operator: str, name: str, body: StepIn, method: Callable[[Project], Callable[..., Reverted]]
) -> StepOut:
    if ctx.jobs.stores_boxes(name, operator):
        # the import is one action: what it stores after its undo could not be undone
        raise HistoryError("your import of boxes is still running; stop it or wait, then undo it as a whole")
    project = ctx.project(name)
    ctx.follow_runs.stop(project, operator)
    try:
        reverted = method(project)(operator, skip=body.skip, effort=body.stored_effort())
    except HistoryError as error:
        if error.frame_id is None:
            raise
        present = frame_state(ctx, name, error.frame_id, operator).model_dump(mode="json")
        answer = error_response("HistoryError", str(error), 409, frame=error.frame_id, state=present)
        raise AnsweredError(answer) from error
    ctx.follow_runs.forget(project, operator, reverted.original)
    ctx.hub.frames_changed(project, ((reverted.frame_id, reverted.receipt), *reverted.others), operator)
    state = frame_state(ctx, name, reverted.frame_id, operator)
    return StepOut.model_construct(frame=reverted.frame_id, state=state, done=reverted.words)


# The URL identifies the content (an image's URL contains a version), so it may be cached forever.
CACHE_FOREVER = "private, max-age=31536000, immutable"

ViewId = Annotated[str, Path(pattern=r"^[0-9a-f]{64}$")]


@router.get("/api/projects/{name}/frames/{frame_id}/image.jpg", response_class=Response)
def image(ctx: Ctx, name: str, frame_id: RowId, v: str | None = None) -> Response:
    """The camera image. With the version `v` from a frame's state, browsers may cache it."""
    opened = ctx.caches.frames.open(ctx.project(name), frame_id)
    return Response(opened.jpeg, media_type="image/jpeg", headers={"Cache-Control": CACHE_FOREVER if v else "no-cache"})


@router.get("/api/projects/{name}/views/{view_id}.png", response_class=Response)
def view(ctx: Ctx, name: str, view_id: ViewId) -> Response:
    """The image of a pseudo-view, from the cache or the project."""
    project = ctx.project(name)
    content = ctx.caches.view_images.get(view_id)
    if content is None:
        content = project.views.content(view_id)
    return Response(content, media_type="image/png", headers={"Cache-Control": CACHE_FOREVER, "ETag": f'"{view_id}"'})
