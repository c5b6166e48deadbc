"""A proxy from browsers to viser servers, on the application's port."""

from __future__ import annotations

import asyncio
import logging
from typing import Protocol, runtime_checkable

import httpx
from fastapi import WebSocket
from starlette.requests import Request
from starlette.responses import Response
from starlette.websockets import WebSocketDisconnect, WebSocketState
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.typing import Origin, Subprotocol

from annotator.web.viewport.server import HOST

LOG = logging.getLogger("annotator.web")

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


@runtime_checkable
class ViserEndpoint(Protocol):
    """A viser server behind the proxy.

    Attributes:
        id: its name in messages.
        port: on `HOST`.
        origin: a secret that it requires of every connection.
    """

    id: str
    port: int
    origin: str


async def forward_http(request: Request, viewport: ViserEndpoint, path: str) -> Response:
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


async def forward_socket(browser: WebSocket, viewport: ViserEndpoint) -> None:
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
