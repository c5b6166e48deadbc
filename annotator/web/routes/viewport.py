"""3D viewports: open one, set its scene, and reach its viser server through the application's port."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Annotated, Literal

import numpy as np
from fastapi import APIRouter, Depends, FastAPI, Response, WebSocket
from pydantic import Field
from starlette.requests import HTTPConnection, Request

from annotator.project import Project
from annotator.types import BoxKind, Label, OrientedBox, ReviewState
from annotator.web.context import Ctx, Operator
from annotator.web.schemas import MOST_BOXES, Axes, Box2DJson, Box3DJson, ClassName, RowId, Schema, Uid
from annotator.web.viewport.drawing import MOST_POINTS, Draft, Gizmo, PointColor, SceneContent, ShownBox
from annotator.web.viewport.viewports import Viewports, forward_http, forward_socket
from annotator.workflows.workbench.drawing_steps import label_object
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.frame_state import present_page


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    app.state.viewports = Viewports(app.state.context.hub.send)
    yield
    app.state.viewports.close()


router = APIRouter(tags=["viewport"], lifespan=_lifespan)


async def _viewports(connection: HTTPConnection) -> Viewports:
    viewports: Viewports = connection.app.state.viewports
    return viewports


OpenViewports = Annotated[Viewports, Depends(_viewports)]
ViewportId = Annotated[str, Field(pattern="^[0-9a-f]{16}$")]


class NewViewport(Schema):
    """The project whose frames the viewport will show."""

    project: ClassName


class OpenedViewport(Schema):
    """A new viewport; `url` is for an iframe."""

    id: str
    url: str


class DraftJson(Schema):
    """An object that is being labelled: its box on the image, the drawn or suggested boxes on its views, and the axes
    of the second step's front view."""

    image_box: Box2DJson
    boxes: Annotated[tuple[Box2DJson | None, ...], Field(max_length=4)] = ()
    axes: Axes | None = None
    box_kind: BoxKind = BoxKind.SILHOUETTE


class PreviewJson(Schema):
    """An unstored box: it replaces that of the label `uid`, or is additional (null, or an unknown uid)."""

    uid: Uid | None
    box: Box3DJson


class SceneRequest(Schema):
    """The content of a viewport. Omitted fields take their defaults, so each request is complete.

    `added` are unstored boxes; `preview` is the box that is being changed. `point_size` is a factor of the default
    size, which depends on the cloud's distance. `reset_view` resets the viewport's camera.
    """

    frame: RowId | None
    selected: Uid | None = None
    gizmo: Gizmo = Gizmo.OFF
    labels: Literal["all", "none"] = "all"
    draft: DraftJson | None = None
    preview: PreviewJson | None = None
    added: Annotated[tuple[PreviewJson, ...], Field(max_length=MOST_BOXES)] = ()
    point_size: Annotated[float, Field(ge=0.05, le=20, allow_inf_nan=False)] | None = None
    color: PointColor = PointColor.RGB
    most_points: Annotated[int, Field(ge=1000, le=MOST_POINTS)] = MOST_POINTS
    reset_view: bool = False


class SceneAnswer(Schema):
    """Number of shown points and of all points, processing time, and whether a browser is connected."""

    shown_points: int
    points: int
    ms: float
    connected: bool


@router.post("/api/workbench", status_code=201)
def open_viewport(body: NewViewport, ctx: Ctx, operator: Operator, viewports: OpenViewports) -> OpenedViewport:
    """Open a 3D viewport; beyond the limit per operator, the oldest one is closed."""
    ctx.project(body.project)
    viewport = viewports.open(operator, body.project)
    return OpenedViewport(id=viewport.id, url=f"/viser/{viewport.id}/")


@router.put("/api/workbench/{id}/scene")
def show_scene(
    id: ViewportId, body: SceneRequest, ctx: Ctx, operator: Operator, viewports: OpenViewports
) -> SceneAnswer:
    """Show a frame, its boxes, and an object that is being labelled."""
    began = time.perf_counter()
    viewport = viewports.get(id, operator)
    project = ctx.project(viewport.project)
    content = SceneContent(None, None) if body.frame is None else _content(ctx, project, body, body.frame)
    counts = viewport.show(content)
    took_ms = (time.perf_counter() - began) * 1000
    return SceneAnswer(
        shown_points=counts.shown_points, points=counts.points, ms=round(took_ms, 1), connected=viewport.sockets > 0
    )


@router.delete("/api/workbench/{id}", status_code=204)
def close_viewport(id: ViewportId, operator: Operator, viewports: OpenViewports) -> None:
    """Close a 3D viewport."""
    viewports.close_one(id, operator)


@router.get("/viser/{id}/{path:path}", include_in_schema=False)
async def viser_file(id: str, path: str, request: Request, operator: Operator, viewports: OpenViewports) -> Response:
    """A file of a viewport's viser server."""
    return await forward_http(request, viewports.get(id, operator), path)


@router.websocket("/viser/{id}")
async def viser_socket(id: str, socket: WebSocket, operator: Operator, viewports: OpenViewports) -> None:
    """The WebSocket of a viewport's viser server."""
    viewport = viewports.get(id, operator)
    viewports.connected(viewport, +1)
    try:
        await forward_socket(socket, viewport)
    finally:
        viewports.connected(viewport, -1)


def _content(ctx: Ctx, project: Project, body: SceneRequest, frame_id: int) -> SceneContent:
    opened = ctx.caches.frames.open(project, frame_id)
    page = present_page(project, frame_id, opened)
    labels = [stored.label for stored in page.labels] if body.labels == "all" else []
    previews = [*body.added, *([] if body.preview is None else [body.preview])]
    return SceneContent(
        key=(project.path.name, page.frame.recording_id),
        frame=opened.frame,
        boxes=_boxes(labels, [(preview.uid, preview.box.box()) for preview in previews]),
        selected=body.selected,
        gizmo=body.gizmo,
        draft=None if body.draft is None else _draft(project, opened, body.draft),
        color=body.color,
        most_points=body.most_points,
        point_size=1.0 if body.point_size is None else body.point_size,
        reset_camera=body.reset_view,
    )


def _boxes(labels: Sequence[Label], previews: Sequence[tuple[str | None, OrientedBox]]) -> tuple[ShownBox, ...]:
    """The stored boxes and the previews. A preview replaces the box with its uid; of several, the last one is used."""
    states = {label.uid: label.state for label in labels}
    shown = {label.uid: ShownBox(label.uid, label.box, label.state) for label in labels}
    without_uid = [ShownBox(None, box, ReviewState.PROPOSED) for uid, box in previews if uid is None]
    for uid, box in previews:
        if uid is not None:
            shown[uid] = ShownBox(uid, box, states.get(uid, ReviewState.PROPOSED))
    return (*shown.values(), *without_uid)


def _draft(project: Project, opened: OpenFrame, body: DraftJson) -> Draft:
    """The draft with the views of its present step, which are cached since the page has requested them before."""
    image_box = body.image_box.box()
    drawn = [None if box is None else box.box() for box in body.boxes]
    axes = None if body.axes is None else np.array(body.axes)
    labelling = label_object(project, opened, image_box, drawn, body.box_kind, axes, None)
    return Draft(image_box, labelling.steps[-1].views if labelling.steps else (), labelling.box)
