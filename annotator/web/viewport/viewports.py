"""The open 3D viewports, and the routes that open one, set its scene, and lead to its viser page."""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from fastapi import APIRouter, Depends, FastAPI, WebSocket
from pydantic import Field
from starlette.requests import HTTPConnection, Request
from starlette.responses import Response

from annotator.project import Project
from annotator.project.overview import read_page
from annotator.types import BoxKind, Label, OrientedBox, ReviewState
from annotator.types.errors import AnnotatorError, NotFoundError
from annotator.web.background import Periodic
from annotator.web.context import Ctx, Operator
from annotator.web.schemas import MOST_BOXES, Box2DJson, Box3DJson, ClassName, Planes, RowId, Schema, Uid
from annotator.web.viewport.drawing import MOST_POINTS, Ahead, Draft, Gizmo, PointColor, SceneContent, ShownBox, pick
from annotator.web.viewport.faces import moved_face
from annotator.web.viewport.guides import Look
from annotator.web.viewport.palette import Theme
from annotator.web.viewport.scene import Scene
from annotator.web.viewport.viser_page import ViserPage, forward_http, forward_socket
from annotator.workflows.workbench.drawing_steps import label_object
from annotator.workflows.workbench.frame_cache import OpenFrame

if TYPE_CHECKING:
    import viser

LOG = logging.getLogger("annotator.web")

# A drag whose end event is missing (the browser may have crashed) is assumed to be over after this time, seconds.
DRAG_ENDS_S = 5.0
# Maximum number of viewports per operator; the oldest ones close.
MOST_PER_OPERATOR = 6
# A viewport without a connected browser closes after this time, which exceeds a reload or reconnection, seconds.
UNSEEN_S = 60.0
SWEEP_S = 5.0

Send = Callable[[dict[str, Any], str], None]
"""Sends an event to the pages of an operator, which ignore those of other viewports; called from any thread."""


class Viewport(ViserPage):
    """One viewport; `show` is thread-safe. Its id is not guessable.

    Attributes:
        sockets: number of browsers connected through the proxy.
        used_s: time of its last use, `time.monotonic`.
    """

    def __init__(self, id: str, operator: str, project: str, send: Send) -> None:
        super().__init__(id)
        self.operator, self.project = operator, project
        self.sockets = 0
        self.used_s = time.monotonic()
        self._send = send
        self._lock = threading.Lock()
        self._dragged_s: float | None = None
        self._grabbed: tuple[str | None, OrientedBox, int, np.ndarray] | None = None
        self._scene = Scene(self._server, self._gizmo_moved, self._face_dragged)
        self._server.scene.on_click()(self._clicked)

    def show(self, content: SceneContent) -> tuple[int, int]:
        """As `Scene.show`. While an operator drags the selected box, it stays where it is dragged."""
        with self._lock:
            self.used_s = time.monotonic()
            dragged = self._dragged_s is not None and time.monotonic() - self._dragged_s < DRAG_ENDS_S
            same = content.selected == self._scene.content.selected
            return self._scene.show(content, hold_gizmo=dragged and same)

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        with _logged("a click"):
            boxes = [shown for shown in self._scene.content.boxes if shown.uid is not None]
            ray = np.array(event.ray_origin, np.float64), np.array(event.ray_direction, np.float64)
            index = pick([shown.box for shown in boxes], *ray)
            if index is not None:
                self.send("select", uid=boxes[index].uid)

    async def _gizmo_moved(self, event: viser.TransformControlsEvent) -> None:
        # a coroutine: viser runs coroutines in order on its event loop, but plain functions in a pool in any order
        with _logged("a move of the gizmo"):
            box = self._scene.gizmo_box()
            if box is not None:
                self._dragged(event.phase, box)
            if event.phase == "end":
                self._grabbed = None

    async def _face_dragged(self, event: viser.SceneNodeDragEvent[viser.BatchedMeshHandle]) -> None:
        with _logged("a drag of a face"):
            selected = self._scene.content.selected_box
            if event.phase == "start" and selected is not None and event.instance_index is not None:
                self._grabbed = selected.uid, selected.box, event.instance_index, np.array(event.start_position)
            # another box may have been selected meanwhile
            if self._grabbed is None or selected is None or selected.uid != self._grabbed[0]:
                self._grabbed = self._dragged_s = None
                return
            eye_m = np.array(event.client.camera.position)
            _, before, face, at_m = self._grabbed
            box = moved_face(before, face, eye_m, at_m, np.array(event.end_position))
            with self._lock:
                self._scene.place_selected(box)
            self._dragged(event.phase, box)

    def _dragged(self, phase: str, box: OrientedBox) -> None:
        """The operator drags the selected box to this one."""
        self._dragged_s = None if phase == "end" else time.monotonic()
        selected = self._scene.content.selected_box
        if phase != "start" and selected is not None:
            self.send("box", uid=selected.uid, box=Box3DJson.of(box).model_dump(), final=phase == "end")

    def send(self, event: str, **fields: object) -> None:
        self.used_s = time.monotonic()
        message = {"type": "viewport", "project": self.project, "workbench": self.id, "event": event, **fields}
        self._send(message, self.operator)


@contextmanager
def _logged(what: str) -> Iterator[None]:
    """Logs an exception of a viser callback together with the event that caused it."""
    try:
        yield
    except Exception:
        LOG.exception("viewport: %s failed", what)


class ViewportClosedError(NotFoundError):
    """There is no such viewport: it is closed, or another operator's. The page opens a new one."""


class Viewports:
    """The open viewports: limits their number per operator, and closes unused ones. Thread-safe."""

    def __init__(self, send: Send, *, unseen_s: float = UNSEEN_S, sweep_s: float = SWEEP_S) -> None:
        self._send, self._unseen_s = send, unseen_s
        self._lock = threading.Lock()
        self._open: dict[str, Viewport] = {}
        self._sweeper = Periodic("viewports", sweep_s, self._sweep)
        self._sweeper.start()

    def open(self, operator: str, project: str) -> Viewport:
        """Opens a viewport; closes the operator's oldest ones beyond the limit."""
        new = Viewport(secrets.token_hex(8), operator, project, self._send)
        with self._lock:
            self._open[new.id] = new
            of_operator = [viewport for viewport in self._open.values() if viewport.operator == operator]
            surplus = [self._open.pop(viewport.id) for viewport in of_operator[:-MOST_PER_OPERATOR]]
        for viewport in surplus:
            viewport.close()
        return new

    def get(self, id: str, operator: str) -> Viewport:
        with self._lock:
            viewport = self._open.get(id)
        if viewport is None or viewport.operator != operator:
            raise ViewportClosedError(f"3D viewport {id} is closed; reload the page to open a new one")
        return viewport

    def close_one(self, id: str, operator: str) -> None:
        viewport = self.get(id, operator)
        with self._lock:
            removed = self._open.pop(id, None)
        if removed is not None:
            viewport.close()

    def close(self) -> None:
        """Closes all viewports."""
        self._sweeper.close()
        with self._lock:
            viewports = list(self._open.values())
            self._open.clear()
        for viewport in viewports:
            viewport.close()

    def connected(self, viewport: Viewport, change: int) -> None:
        """Counts a browser that has connected to a viewport (+1) or disconnected (-1)."""
        with self._lock:
            viewport.sockets += change
            viewport.used_s = time.monotonic()
        viewport.send("connected", connected=viewport.sockets > 0)

    def _sweep(self) -> None:
        now = time.monotonic()
        with self._lock:
            for viewport in self._open.values():
                if viewport.sockets > 0:
                    viewport.used_s = now
            unseen = [viewport for viewport in self._open.values() if now - viewport.used_s > self._unseen_s]
            for viewport in unseen:
                del self._open[viewport.id]
        for viewport in unseen:
            LOG.info("viewport %s of %s closed: no page shows it", viewport.id, viewport.operator)
            viewport.close()


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
Colour = Annotated[str, Field(pattern="^#[0-9a-f]{6}$")]
ViewportId = Annotated[str, Field(pattern="^[0-9a-f]{16}$")]


class NewViewport(Schema):
    """The project whose frames the viewport will show."""

    project: ClassName


class OpenedViewport(Schema):
    """A new viewport; `url` is for an iframe."""

    id: str
    url: str


class DraftJson(Schema):
    """An object that is being labelled: its box on the image, the drawn or suggested boxes on its views, and the planes
    of these."""

    image_box: Box2DJson
    boxes: Annotated[tuple[Box2DJson | None, ...], Field(max_length=4)] = ()
    planes: Planes = ()
    box_kind: BoxKind = BoxKind.SILHOUETTE


class PreviewJson(Schema):
    """An unstored box: it replaces that of the label `uid`, or is additional (an unknown uid)."""

    uid: Uid
    box: Box3DJson


class SceneRequest(Schema):
    """The content of a viewport. Omitted fields take their defaults, so each request is complete.

    `previews` are unstored boxes. `point_size` is a factor of the default size, which depends on the cloud's distance.
    `colors` are those of boxes, #rrggbb by uid; others have that of their state. `hide_ground` and `most_height` (above
    the ground, metres) leave out points, `only_selected` also other boxes. `look` moves the viewer. `ahead` is a frame
    that may be shown next: its points are sent without being shown.
    """

    frame: RowId | None
    selected: Uid | None = None
    gizmo: Gizmo = Gizmo.OFF
    draft: DraftJson | None = None
    previews: Annotated[tuple[PreviewJson, ...], Field(max_length=MOST_BOXES)] = ()
    point_size: Annotated[float, Field(ge=0.05, le=20, allow_inf_nan=False)] = 1.0
    color: PointColor = PointColor.RGB
    most_points: Annotated[int, Field(ge=1000, le=MOST_POINTS)] = MOST_POINTS
    colors: Annotated[dict[Uid, Colour], Field(default_factory=dict, max_length=MOST_BOXES)]
    hide_ground: bool = False
    most_height: Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)] | None = None
    only_selected: bool = False
    look: Look | None = None
    theme: Theme = Theme.DARK
    ahead: RowId | None = None


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
    shown_points, points = viewport.show(content)
    took_ms = (time.perf_counter() - began) * 1000
    return SceneAnswer(shown_points=shown_points, points=points, ms=round(took_ms, 1), connected=viewport.sockets > 0)


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
    page = read_page(project, frame_id)
    labels = [stored.label for stored in page.labels]
    return SceneContent(
        key=(project.path.name, page.frame.recording_id),
        frame=opened.frame,
        boxes=_boxes(labels, body.previews, body.colors),
        selected=body.selected,
        gizmo=body.gizmo,
        draft=None if body.draft is None else _draft(project, opened, body.draft),
        color=body.color,
        most_points=body.most_points,
        point_size=body.point_size,
        hide_ground=body.hide_ground,
        most_height_m=body.most_height,
        only_selected=body.only_selected,
        look=body.look,
        theme=body.theme,
        ground=opened.ground,
        ahead=None if body.ahead is None else _ahead(ctx, project, body.ahead),
    )


def _ahead(ctx: Ctx, project: Project, frame_id: int) -> Ahead | None:
    """A frame that may be shown next; None if it cannot be read, or is gone: whoever opens it is told."""
    try:
        # each scene asks for this frame and the shown one: their neighbours would be read ahead in turn
        opened = ctx.caches.frames.open(project, frame_id, None)
    except AnnotatorError:
        return None
    return Ahead(opened.frame, opened.ground)


def _boxes(labels: Sequence[Label], previews: Sequence[PreviewJson], colors: Mapping[str, str]) -> tuple[ShownBox, ...]:
    """The stored boxes and the previews, which replace the boxes with their uids."""
    shown = {label.uid: (label.box, label.state) for label in labels}
    for preview in previews:
        _, state = shown.get(preview.uid, (None, ReviewState.PROPOSED))
        shown[preview.uid] = preview.box.box(), state
    return tuple(ShownBox(uid, box, state, _rgb(colors.get(uid))) for uid, (box, state) in shown.items())


def _rgb(color: str | None) -> tuple[int, int, int] | None:
    if color is None:
        return None
    red, green, blue = bytes.fromhex(color[1:])
    return red, green, blue


def _draft(project: Project, opened: OpenFrame, body: DraftJson) -> Draft:
    """The draft with the views of its present step, which are cached since the page has requested them before."""
    image_box = body.image_box.box()
    drawn = [None if box is None else box.box() for box in body.boxes]
    planes = [None if plane is None else plane.geometry() for plane in body.planes]
    labelling = label_object(project, opened, image_box, drawn, body.box_kind, planes, None)
    return Draft(image_box, labelling.steps[-1].views if labelling.steps else (), labelling.box)
