"""The socket of events: what happens elsewhere reaches the open pages."""

from __future__ import annotations

import asyncio
from typing import Annotated, Literal

from fastapi import APIRouter, Query, WebSocket, WebSocketDisconnect
from pydantic import Field, TypeAdapter, ValidationError
from starlette.concurrency import run_in_threadpool

from annotator.web.context import Context, Ctx, Operator
from annotator.web.hub import Client
from annotator.web.wire import ClassName, RowId, Wire

router = APIRouter()

# A page that does not take an event within this time is gone, or as good as gone.
SEND_WITHIN_S = 10.0
BAD_MESSAGE, TOO_SLOW = 1007, 1013


class Opened(Wire):
    """The page shows a frame now."""

    type: Literal["open"]
    project: ClassName
    frame: RowId


class Closed(Wire):
    """The page shows no frame any more."""

    type: Literal["close"]


class Shows(Wire):
    """The page shows a 3D view: that view's events are for it alone."""

    type: Literal["workbench"]
    id: Annotated[str, Field(max_length=64)]


Said = TypeAdapter[Opened | Closed | Shows](Annotated[Opened | Closed | Shows, Field(discriminator="type")])


@router.websocket("/api/events")
async def events(
    socket: WebSocket, ctx: Ctx, who: Operator, project: Annotated[str | None, Query(max_length=64)] = None
) -> None:
    """Events to a page, and from it which frame it shows."""
    if project is not None:
        await run_in_threadpool(ctx.project, project)
    await socket.accept()
    client = Client(project, who)
    ctx.hub.join(client)
    ways = [asyncio.create_task(_send(socket, client)), asyncio.create_task(_receive(socket, ctx, client))]
    try:
        await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
    finally:
        ctx.hub.leave(client)
        for way in ways:
            way.cancel()
        await asyncio.gather(*ways, return_exceptions=True)


async def _send(socket: WebSocket, client: Client) -> None:
    try:
        while (message := await client.queue.get()) is not None:
            await asyncio.wait_for(socket.send_json(message), SEND_WITHIN_S)
        await asyncio.wait_for(socket.close(TOO_SLOW), SEND_WITHIN_S)
    except (TimeoutError, WebSocketDisconnect, RuntimeError):  # gone while it was being sent something
        return


async def _receive(socket: WebSocket, ctx: Context, client: Client) -> None:
    try:
        while True:
            _take(ctx, client, await socket.receive_text())
    except ValidationError:
        await socket.close(BAD_MESSAGE, "not a message that this socket takes")
    except (WebSocketDisconnect, KeyError):  # a message in bytes has no text
        return


def _take(ctx: Context, client: Client, text: str) -> None:
    match Said.validate_json(text):
        case Opened(project=project, frame=frame):
            ctx.hub.opened(client, project, frame)
        case Closed():
            ctx.hub.opened(client, None, None)
        case Shows(id=workbench):
            ctx.hub.shows(client, workbench)
