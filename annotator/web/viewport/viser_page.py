"""A page of viser with its own server on loopback, and the proxy through which browsers reach it."""

from __future__ import annotations

import asyncio
import logging
import secrets
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import httpx
from fastapi import WebSocket
from starlette.requests import Request
from starlette.responses import Response
from starlette.websockets import WebSocketDisconnect, WebSocketState
from websockets.asyncio.client import ClientConnection, connect
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.protocol import State
from websockets.typing import Origin, Subprotocol

from annotator.web.viewport.palette import Theme

if TYPE_CHECKING:
    import viser

LOG = logging.getLogger("annotator.web")

HOST = "127.0.0.1"
# Connections of one viser server whose request has not come yet; the proxy needs few, and only for a moment.
MOST_SILENT = 32

_starting = threading.Lock()


def start_viser(host: str, origin: str) -> viser.ViserServer:
    """A viser server on a free port of `host`, which refuses every WebSocket whose `Origin` is not `origin`.

    Any page in any browser on this computer may open a WebSocket to a port of 127.0.0.1, and viser accepts all of them.
    With a secret origin, which no browser sends, only the proxy can connect.
    """
    import rich
    import viser

    # viser prints on start and stop, even with `verbose=False`; nothing else uses this console
    rich.get_console().quiet = True
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
        self._server = start_viser(HOST, self.origin)
        self.port = self._server.get_port()
        configure_theme(self._server, Theme.DARK)

    def close(self) -> None:
        """Stops the server, which disconnects its browsers."""
        self._server.stop()


def configure_theme(server: viser.ViserServer, theme: Theme) -> None:
    """The background of a viser page, without anything of viser's own."""
    server.gui.configure_theme(dark_mode=theme is Theme.DARK, show_logo=False, show_share_button=False)


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
