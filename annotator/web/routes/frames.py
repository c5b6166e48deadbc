"""Frames: the list, the state of one frame, changes, undo and redo."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

import numpy as np
from fastapi import APIRouter, Path, Query
from fastapi.responses import JSONResponse, Response
from pydantic import Field

from annotator.geometry.projection import every_nth
from annotator.image_bytes import encoded_image
from annotator.project import History, Origin, Reverted
from annotator.project.changes import (
    FrameFinalised,
    ImageBoxesSet,
    LabelChanged,
    LabelDeleted,
    NewLabel,
    Payload,
)
from annotator.project.overview import neighbours
from annotator.project.records import BoxRecord
from annotator.rcv.pseudo_view import Window, render_window
from annotator.types import BoxKind, ReviewState, Suggestion
from annotator.types.bases import TrackId
from annotator.types.errors import ConfigError, HistoryError
from annotator.web.context import AtProject, Ctx, InProject
from annotator.web.errors import AnsweredError, error_response
from annotator.web.frame_json import STALE, AtFrame, InFrame, ModelResponse
from annotator.web.schemas import (
    MOST_BOXES,
    Box2DJson,
    FrameChange,
    FrameStateJson,
    LabelValues,
    Metres,
    RowId,
    Schema,
    Uid,
    WithEffort,
)
from annotator.workflows.workbench.save_object import apply_changes

DECIDED = {"accept": ReviewState.ACCEPTED, "reject": ReviewState.REJECTED}


class Decide(Schema):
    """Accepts a label unchanged, rejects it (the object does not exist), or removes it: it may be proposed again.

    `here`: of an object that stands still, only in this frame.
    """

    kind: Literal["accept", "reject", "delete"]
    uid: Uid
    here: bool = False

    def payload(self) -> Payload:
        if self.kind == "delete":
            return LabelDeleted(uid=self.uid, here=self.here)
        return LabelChanged(uid=self.uid, state=DECIDED[self.kind], here=self.here)


class Edit(LabelValues):
    """Changes a label's class, box and track; with `box_kind`, also what its box encloses. `here`: see `Decide`."""

    kind: Literal["edit"]
    uid: Uid
    box_kind: BoxKind | None = None
    here: bool = False

    def payload(self) -> Payload:
        box = BoxRecord.of(self.box.box())
        return LabelChanged(
            uid=self.uid,
            state=ReviewState.EDITED,
            label=self.label,
            box=box,
            track_id=self.track_id,
            box_kind=self.box_kind,
            here=self.here,
        )


class Track(Schema):
    """Changes a label's track, or removes it from its track; its review state stays."""

    kind: Literal["track"]
    uid: Uid
    track_id: TrackId | None

    def payload(self) -> Payload:
        return LabelChanged(uid=self.uid, track_id=self.track_id)


class Create(LabelValues):
    """Creates an accepted label.

    `image_box` is the box on the image that it was fitted to, if any; `suggestion` the detector that fitted it.
    """

    kind: Literal["create"]
    image_box: Box2DJson | None = None
    suggestion: Suggestion | None = None

    def payload(self) -> Payload:
        return NewLabel(
            self.label,
            self.box.box(),
            track_id=self.track_id,
            origin=Origin.PLACED if self.image_box is None else Origin.DRAWN,
            image_box=None if self.image_box is None else self.image_box.box(),
            suggestion=self.suggestion,
        )


class ImageBoxesIn(Schema):
    """Replaces all boxes on the camera image."""

    kind: Literal["image_boxes"]
    boxes: Annotated[list[Box2DJson], Field(max_length=MOST_BOXES)]
    box_kind: BoxKind

    def payload(self) -> Payload:
        return ImageBoxesSet(boxes=tuple(box.box() for box in self.boxes), box_kind=self.box_kind)


class Finalise(Schema):
    """Finalises the frame, or reopens it."""

    kind: Literal["finalise", "reopen"]

    def payload(self) -> Payload:
        return FrameFinalised(finalised=self.kind == "finalise")


ChangeIn = Annotated[Decide | Edit | Track | Create | ImageBoxesIn | Finalise, Field(discriminator="kind")]


class ChangesIn(FrameChange):
    """Changes of one frame, based on one revision of it."""

    changes: Annotated[list[ChangeIn], Field(min_length=1, max_length=MOST_BOXES)]
    subject: Uid | None = None

    def sent(self) -> list[Any]:
        changes: list[Any] = self.model_dump(mode="json", exclude_unset=True)["changes"]
        return changes


class ChangedJson(FrameStateJson):
    """The frame's present state, and the number of boxes that have moved along in other frames."""

    moved: int


router = APIRouter(tags=["frames"])


class StepIn(WithEffort):
    """`skip`: skip actions whose targets another operator has changed since."""

    skip: bool = False


class StepOut(Schema):
    """The undone or redone action (`done`, in words), its frame, and the frame's present state.

    A change of the classes has no frame.
    """

    frame: int | None
    state: FrameStateJson | None
    done: str


class Beside(Schema):
    """The frames before and after one in its recording."""

    previous: int | None
    next: int | None


@router.get("/api/projects/{name}/first-frame")
def first_frame(at: AtProject) -> int | None:
    """The first frame of the project."""
    return at.project.frames.first()


@router.get("/api/projects/{name}/frames/{frame_id}/beside")
def beside(at: AtFrame) -> Beside:
    """The frames beside one, also beside one that cannot be read."""
    previous, following = neighbours(at.project, at.project.frames.get(at.frame_id))
    return Beside(previous=previous, next=following)


@router.get("/api/projects/{name}/frames/{frame_id}", response_model=FrameStateJson)
def frame(at: AtFrame, best_for: Uid | None = None) -> JSONResponse:
    """All data of a frame that the page shows; `best_for`: of the camera of its moment that sees this label best."""
    return ModelResponse(at.state(best_for))


@router.post("/api/projects/{name}/frames/{frame_id}/changes", response_model=ChangedJson, responses=STALE)
def changes(at: AtFrame, body: ChangesIn) -> JSONResponse:
    """Change one frame: all changes or none, as one undo step. Unreviewed boxes of a corrected track move along."""
    with at.change(body):
        context = body.context(at.operator, body.subject)
        payloads = [entry.payload() for entry in body.changes]
        moved = apply_changes(at.project, at.frame_id, payloads, context, at.open, at.recording)
    return ModelResponse(ChangedJson.of(at.state(), moved=moved))


@router.post("/api/projects/{name}/undo", responses=STALE)
def undo(at: AtProject, body: StepIn) -> StepOut:
    """Undo the operator's last action, on whichever frame. A run that follows objects is stopped first.

    A job that is undone while it stores boxes ends.
    """
    return _step(at, body, History.undo)


@router.post("/api/projects/{name}/redo", responses=STALE)
def redo(at: AtProject, body: StepIn) -> StepOut:
    """Redo the action that was undone last; otherwise as `undo`."""
    return _step(at, body, History.redo)


def _step(at: InProject, body: StepIn, method: Callable[..., Reverted]) -> StepOut:
    ctx, project, operator = at.ctx, at.project, at.operator
    ctx.follow_runs.stop(project, operator)
    try:
        reverted = method(project.history, operator, skip=body.skip, effort=body.stored_effort())
    except HistoryError as error:
        if not error.can_skip:
            raise
        present = None  # of a change of the classes
        if error.frame_id is not None:
            present = InFrame(ctx, at.name, operator, error.frame_id).state().model_dump(mode="json")
        answer = error_response("HistoryError", str(error), 409, frame=error.frame_id, state=present)
        raise AnsweredError(answer) from error
    ctx.follow_runs.forget(project, operator, reverted.original)
    at.announce()
    state = None if reverted.frame_id is None else InFrame(ctx, at.name, operator, reverted.frame_id).state()
    return StepOut.model_construct(frame=reverted.frame_id, state=state, done=reverted.words)


# The URL identifies the content (an image's URL contains a version), so it may be cached forever.
CACHE_FOREVER = "private, max-age=31536000, immutable"

ViewId = Annotated[str, Path(pattern=r"^[0-9a-f]{64}$")]


@router.get("/api/projects/{name}/frames/{frame_id}/image.jpg", response_class=Response)
def image(
    ctx: Ctx,
    name: str,
    frame_id: RowId,
    v: str | None = None,
    width: Annotated[int | None, Query(ge=32, le=640)] = None,
) -> Response:
    """The camera image; with a `width`, a small picture of it. With a version `v` from the server, browsers may cache
    it.
    """
    project, frames = ctx.project(name), ctx.caches.frames
    content = frames.open(project, frame_id).jpeg if width is None else frames.small(project, frame_id, width)
    return Response(content, media_type="image/jpeg", headers={"Cache-Control": CACHE_FOREVER if v else "no-cache"})


# Share of the points that the top view shows first, percent: a few lie far behind the others, but of a LiDAR's points
# most lie near, and its far objects have hardly any.
MAP_PERCENT = 99.0


@router.get("/api/projects/{name}/frames/{frame_id}/reach")
def reach(at: AtFrame) -> float:
    """How far most of a frame's points are from the camera, metres; 0 without points."""
    xyz_m = every_nth(at.open().frame.cloud.xyz_m, 10_000)
    return float(np.percentile(np.linalg.norm(xyz_m, axis=1), MAP_PERCENT)) if len(xyz_m) else 0.0


Share = Annotated[float, Field(ge=-1.01, le=1.01, allow_inf_nan=False)]
Axis = Annotated[list[Share], Query(min_length=3, max_length=3)]
MapSide = Annotated[int, Query(ge=1, le=4096)]


@router.get("/api/projects/{name}/frames/{frame_id}/map.png", response_class=Response)
def map_picture(
    at: AtFrame,
    right: Axis,
    down: Axis,
    left_m: Metres,
    top_m: Metres,
    metres_per_px: Annotated[float, Query(ge=1e-4, le=100.0)],
    width: MapSide,
    height: MapSide,
    v: str | None = None,
) -> Response:
    """A part of the plane with these axes (unit vectors of the camera frame), from its left upper corner."""
    axes = np.array([right, down, np.cross(right, down)])
    if not np.allclose(axes @ axes.T, np.eye(3), atol=1e-3):
        raise ConfigError("right and down must be perpendicular unit vectors")
    window = Window(np.array([left_m, top_m]), metres_per_px, width, height)
    content = encoded_image(render_window(at.open().frame.cloud, axes, window))
    return Response(content, media_type="image/png", headers={"Cache-Control": CACHE_FOREVER if v else "no-cache"})


@router.get("/api/projects/{name}/views/{view_id}.png", response_class=Response)
def view(ctx: Ctx, name: str, view_id: ViewId) -> Response:
    """The image of a pseudo-view, from the cache or the project."""
    project = ctx.project(name)
    content = ctx.caches.view_images.known(view_id) or project.views.content(view_id)
    return Response(content, media_type="image/png", headers={"Cache-Control": CACHE_FOREVER, "ETag": f'"{view_id}"'})
