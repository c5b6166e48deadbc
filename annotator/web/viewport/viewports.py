"""3D viewports, each with its own viser server on loopback, and the set of open viewports of the server."""

from __future__ import annotations

import asyncio
import logging
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np
from fastapi import WebSocket
from starlette.requests import Request
from starlette.responses import Response
from starlette.websockets import WebSocketDisconnect, WebSocketState
from websockets.asyncio.client import ClientConnection, connect
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.protocol import State
from websockets.typing import Origin, Subprotocol

from annotator.types.errors import NotFoundError
from annotator.web.background import Periodic
from annotator.web.schemas import Box3DJson
from annotator.web.viewport.drawing import SceneContent, pick
from annotator.web.viewport.scene import PointCounts, Scene

if TYPE_CHECKING:
    import viser

LOG = logging.getLogger("annotator.web")


HOST = "127.0.0.1"
# Connections of one viser server whose request has not come yet; the proxy needs few, and only for a moment.
MOST_SILENT = 32

_starting = threading.Lock()
_quiet = threading.Lock()


@contextmanager
def silence() -> Iterator[None]:
    """Suppresses viser's messages on the terminal, which it prints on start and stop even with `verbose=False`."""
    import rich

    with _quiet:
        console = rich.get_console()
        before, console.quiet = console.quiet, True
        try:
            yield
        finally:
            console.quiet = before


def start_viser(host: str, origin: str) -> viser.ViserServer:
    """A viser server on a free port of `host`, which refuses every WebSocket whose `Origin` is not `origin`.

    Any page in any browser on this computer may open a WebSocket to a port of 127.0.0.1, and viser accepts all of them.
    With a secret origin, which no browser sends, only the proxy can connect.
    """
    import viser

    with _starting, _required_origin(origin) as guarded:
        server = viser.ViserServer(host, 0, verbose=False)
    if not guarded:
        server.stop()
        raise RuntimeError(
            "access to the 3D view cannot be restricted with this version of viser; install another version"
        )
    return server


class _FewSilent(ServerConnection):
    """A connection to viser. Other users of this computer can open some, too, but not take all file descriptors."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Accepts a connection; closes the oldest silent one if there are too many."""
        super().connection_made(transport)
        silent = [other for other in self.server.handlers if other.state is State.CONNECTING]
        if len(silent) > MOST_SILENT:
            silent[0].transport.abort()


@contextmanager
def _required_origin(origin: str) -> Iterator[list[str]]:
    """Patches `websockets.serve` to require `origin`, since viser has no option for it.

    The constructor of a viser server returns once it serves, so the patch is active only during the call. Yields the
    list of origins of the servers started so far.
    """
    from websockets.asyncio import server as sockets
    from websockets.typing import Origin

    serve, guarded = sockets.serve, list[str]()

    def guard(*arguments: Any, **options: Any) -> Any:
        guarded.append(origin)
        return serve(*arguments, **options, origins=[Origin(origin)], create_connection=_FewSilent)

    setattr(sockets, "serve", guard)  # noqa: B010  (mypy forbids a plain assignment)
    try:
        yield guarded
    finally:
        setattr(sockets, "serve", serve)  # noqa: B010


FORWARDED_REQUEST = ("accept", "accept-encoding", "if-none-match")
FORWARDED_RESPONSE = ("content-type", "content-encoding", "etag")
# viser's page unpacks itself with inline scripts, WebAssembly and a worker, all contained in its single file.
POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob: data:; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' blob: data:; font-src 'self' data:; "
    "connect-src 'self' blob: data:; worker-src 'self' blob: data:; frame-ancestors 'self'; base-uri 'none'; "
    "form-action 'none'; object-src 'none'"
)
TIMEOUT_S = 10.0
# Close codes that only describe a local state and must not be sent.
UNSENDABLE = (1005, 1006, 1015)
GONE, TRY_AGAIN = 1001, 1013


class ViserPage:
    """A page of viser behind the proxy, with its own server on loopback.

    Attributes:
        id: its name in messages.
        port: of its server, on `HOST`.
        origin: a secret that its server requires of every connection.
    """

    def __init__(self, id: str) -> None:
        self.id = id
        self.origin = f"annotator://{secrets.token_hex(16)}"
        with silence():
            self._server = start_viser(HOST, self.origin)
        self.port = self._server.get_port()
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)

    def close(self) -> None:
        """Stops the server, which disconnects its browsers."""
        with silence():
            self._server.stop()


async def forward_http(request: Request, viewport: ViserPage, path: str) -> Response:
    """Forwards a request for one of viser's files."""
    headers = {name: request.headers[name] for name in FORWARDED_REQUEST if name in request.headers}
    async with (
        # plain HTTP on this machine: no proxy of the environment, and no certificates, which take 60 ms to load
        httpx.AsyncClient(timeout=TIMEOUT_S, trust_env=False, verify=False) as client,
        client.stream(
            "GET", httpx.URL(scheme="http", host=HOST, port=viewport.port, path=f"/{path}"), headers=headers
        ) as response,
    ):
        # raw: without decompression
        body = b"".join([part async for part in response.aiter_raw()])
    headers_out = {name: response.headers[name] for name in FORWARDED_RESPONSE if name in response.headers}
    return Response(body, response.status_code, {**headers_out, "Content-Security-Policy": POLICY})


async def forward_socket(browser: WebSocket, viewport: ViserPage) -> None:
    """Forwards a browser's WebSocket until either side closes it.

    Each direction waits for its receiver, so no messages pile up here: with a slow browser, viser drops outdated ones.
    """
    offered = [Subprotocol(name) for name in browser.scope["subprotocols"]]
    try:
        viser = await connect(
            f"ws://{HOST}:{viewport.port}",
            origin=Origin(viewport.origin),
            subprotocols=offered or None,
            compression=None,
            max_size=None,
            open_timeout=TIMEOUT_S,
            ping_interval=None,
            proxy=None,
        )
    except (OSError, TimeoutError, WebSocketException) as error:
        LOG.warning("viewport %s does not respond: %s", viewport.id, error)
        await browser.close(TRY_AGAIN, "the viewport does not respond")
        return
    async with viser:
        await browser.accept(viser.subprotocol)
        tasks = [asyncio.create_task(_to_browser(viser, browser)), asyncio.create_task(_to_viser(browser, viser))]
        _, waiting = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in waiting:
            task.cancel()
        results = await asyncio.gather(*tasks, return_exceptions=True)
    for result in results:
        if isinstance(result, Exception):
            LOG.error("viewport %s: connection failed", viewport.id, exc_info=result)


async def _to_browser(viser: ClientConnection, browser: WebSocket) -> None:
    try:
        async for message in viser:
            if isinstance(message, bytes):
                await browser.send_bytes(message)
            else:
                await browser.send_text(message)
    except ConnectionClosed:
        pass
    except (WebSocketDisconnect, RuntimeError):
        # the browser disconnected during a send
        return
    if browser.application_state is WebSocketState.CONNECTED and browser.client_state is WebSocketState.CONNECTED:
        code = viser.close_code or GONE
        await browser.close(GONE if code in UNSENDABLE else code, viser.close_reason or "")


async def _to_viser(browser: WebSocket, viser: ClientConnection) -> None:
    while True:
        message = await browser.receive()
        if message["type"] == "websocket.disconnect":
            code = message.get("code") or GONE
            await viser.close(GONE if code in UNSENDABLE else code)
            return
        data = message.get("bytes")
        try:
            await viser.send(message["text"] if data is None else data)
        except ConnectionClosed:
            return


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
        self._scene = Scene(self._server, self._gizmo_moved)
        self._server.scene.on_click()(self._clicked)

    def show(self, content: SceneContent) -> PointCounts:
        """Shows a scene. While an operator drags the gizmo, the selected box stays at the gizmo."""
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
            self._dragged_s = None if event.phase == "end" else time.monotonic()
            box, selected = self._scene.gizmo_box(), self._scene.selected
            if event.phase != "start" and box is not None and selected is not None:
                self.send("box", uid=selected.uid, box=Box3DJson.of(box).model_dump(), final=event.phase == "end")

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
            raise NotFoundError(f"3D viewport {id} is closed; reload the page to open a new one")
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
