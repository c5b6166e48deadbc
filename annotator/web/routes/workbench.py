"""The 3D view: open it, say what it shows, and reach its viser server through this one's port."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from functools import partial
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, FastAPI, Response, WebSocket
from pydantic import Field
from starlette.requests import HTTPConnection, Request

from annotator.project import Project
from annotator.types import BoxKind, Label, OrientedBox, ReviewState
from annotator.web.context import Ctx, Operator
from annotator.web.hub import Hub
from annotator.web.viewport.content import MOST_POINTS, Draft, Gizmo, PointColor, SceneContent, ShownBox
from annotator.web.viewport.proxy import forward_http, forward_socket
from annotator.web.viewport.workbench import Workbench
from annotator.web.viewport.workbenches import Workbenches
from annotator.web.wire import MOST_BOXES, Box2DJson, Box3DJson, ClassName, RowId, Uid, Wire
from annotator.workflows.frame_view import present_page
from annotator.workflows.labelling import label_config, label_steps
from annotator.workflows.open_frame import OpenFrame


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    app.state.workbenches = Workbenches(partial(_send, app.state.context.hub))
    yield
    app.state.workbenches.close()


def _send(hub: Hub, bench: Workbench, message: dict[str, Any]) -> None:
    """An event goes to the operator's pages of that project; the one that shows the workbench knows its id."""
    for client in hub.clients():
        if client.operator == bench.operator and client.project == bench.project:
            hub.shows(client, bench.id)
    hub.send(message)


router = APIRouter(tags=["viewport"], lifespan=_lifespan)


def _workbenches(connection: HTTPConnection) -> Workbenches:
    found: Workbenches = connection.app.state.workbenches
    return found


Benches = Annotated[Workbenches, Depends(_workbenches)]
BenchId = Annotated[str, Field(pattern="^[0-9a-f]{16}$")]


class NewWorkbench(Wire):
    """Whose frames it will show."""

    project: ClassName


class OpenedWorkbench(Wire):
    """A new workbench; `url` is for an iframe."""

    id: str
    url: str


class DraftJson(Wire):
    """An object that is being labelled: its box on the image, and those on the views that were drawn."""

    image_box: Box2DJson
    boxes: Annotated[tuple[Box2DJson | None, ...], Field(max_length=4)] = ()
    box_kind: BoxKind = BoxKind.SILHOUETTE


class PreviewJson(Wire):
    """A box that is not stored: in place of that label's, or an additional one."""

    uid: Uid | None
    box: Box3DJson


class SceneRequest(Wire):
    """What the 3D view shall show. What is left out takes its default, so each request says all.

    `added` are boxes that are not stored yet; `preview` is the one that is being changed. `point_size` is a factor of
    what suits the recording.
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


class SceneAnswer(Wire):
    """How many points are shown of how many there are, how long it took here, and whether a browser looks at it yet."""

    shown_points: int
    points: int
    ms: float
    connected: bool


@router.post("/api/workbench", status_code=201)
def open_workbench(body: NewWorkbench, ctx: Ctx, who: Operator, benches: Benches) -> OpenedWorkbench:
    """Open a 3D view. An operator's oldest one closes where there are too many."""
    ctx.project(body.project)
    made = benches.open(who, body.project)
    return OpenedWorkbench(id=made.id, url=f"/viser/{made.id}/")


@router.put("/api/workbench/{id}/scene")
def show_scene(id: BenchId, body: SceneRequest, ctx: Ctx, who: Operator, benches: Benches) -> SceneAnswer:
    """Show a frame, its boxes, an object that is being labelled."""
    began = time.perf_counter()
    bench = benches.get(id, who)
    project = ctx.project(bench.project)
    shown = bench.show(SceneContent(None, None) if body.frame is None else _content(ctx, project, body, body.frame))
    took_ms = (time.perf_counter() - began) * 1000
    return SceneAnswer(
        shown_points=shown.shown_points, points=shown.points, ms=round(took_ms, 1), connected=bench.sockets > 0
    )


@router.delete("/api/workbench/{id}", status_code=204)
def close_workbench(id: BenchId, who: Operator, benches: Benches) -> None:
    """Close a 3D view."""
    benches.close_one(id, who)


@router.get("/viser/{id}/{path:path}", include_in_schema=False)
async def viser_file(id: str, path: str, request: Request, who: Operator, benches: Benches) -> Response:
    """The page of a workbench's viser server."""
    return await forward_http(request, benches.get(id, who), path)


@router.websocket("/viser/{id}")
async def viser_socket(id: str, socket: WebSocket, who: Operator, benches: Benches) -> None:
    """The connection of that page."""
    bench = benches.get(id, who)
    benches.connected(bench, +1)
    try:
        await forward_socket(socket, bench)
    finally:
        benches.connected(bench, -1)


def _content(ctx: Ctx, project: Project, body: SceneRequest, frame_id: int) -> SceneContent:
    opened = ctx.annotation.frames.open(project, frame_id)
    page = present_page(project, frame_id, opened)
    labels = [stored.label for stored in page.labels] if body.labels == "all" else []
    previews = [*body.added, *([] if body.preview is None else [body.preview])]
    return SceneContent(
        place=(project.path.name, page.frame.recording_id),
        frame=opened.frame,
        boxes=_boxes(labels, [(preview.uid, preview.box.box()) for preview in previews]),
        selected=body.selected,
        gizmo=body.gizmo,
        draft=None if body.draft is None else _draft(project, opened, body.draft),
        color=body.color,
        most_points=body.most_points,
        point_size=1.0 if body.point_size is None else body.point_size,
        reset_view=body.reset_view,
    )


def _boxes(labels: Sequence[Label], previews: Sequence[tuple[str | None, OrientedBox]]) -> tuple[ShownBox, ...]:
    """The stored boxes, and those that are not stored: each in place of the one with its uid, the last one counts."""
    states = {label.uid: label.state for label in labels}
    shown = {label.uid: ShownBox(label.uid, label.box, label.state) for label in labels}
    nameless = [ShownBox(None, box, ReviewState.PROPOSED) for uid, box in previews if uid is None]
    for uid, box in previews:
        if uid is not None:
            shown[uid] = ShownBox(uid, box, states.get(uid, ReviewState.PROPOSED))
    return (*shown.values(), *nameless)


def _draft(project: Project, opened: OpenFrame, body: DraftJson) -> Draft:
    """The views of the present step are those that the page was given: drawn once."""
    image_box = body.image_box.box()
    drawn = [None if box is None else box.box() for box in body.boxes]
    found = label_steps(opened, image_box, drawn, label_config(project, opened.frame), body.box_kind)
    return Draft(image_box, found.steps[-1].views if found.steps else (), found.box)
