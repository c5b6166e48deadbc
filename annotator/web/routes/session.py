"""The session: the operator's name."""

from __future__ import annotations

import asyncio
from typing import Annotated, Literal
from urllib.parse import quote

from fastapi import APIRouter, Query, Request, Response, WebSocket, WebSocketDisconnect
from pydantic import AfterValidator, BaseModel, Field, TypeAdapter, ValidationError
from starlette.concurrency import run_in_threadpool

from annotator import __version__
from annotator.project.database.store import waiting_at_most
from annotator.web.context import (
    LONGEST_NAME,
    OPERATOR_COOKIE,
    Context,
    Ctx,
    Operator,
    check_operator,
    operator_or_none,
)
from annotator.web.hub import Client
from annotator.web.schemas import RowId, Schema

router = APIRouter(tags=["session"])

A_YEAR_S = 365 * 24 * 3600


class SignIn(Schema):
    """The operator's name, stored as the author of changes."""

    operator: Annotated[str, Field(max_length=LONGEST_NAME), AfterValidator(check_operator)]


class Session(BaseModel):
    """The signed-in operator, and the server's version."""

    operator: str | None
    version: str


@router.get("/api/session")
def session(request: Request) -> Session:
    """The operator who is signed in on this browser."""
    return Session(operator=operator_or_none(request), version=__version__)


@router.post("/api/session")
def sign_in(body: SignIn, response: Response) -> Session:
    """Sign in with a name, which becomes the author of all changes."""
    response.set_cookie(OPERATOR_COOKIE, quote(body.operator), max_age=A_YEAR_S, httponly=True, samesite="strict")
    return Session(operator=body.operator, version=__version__)


@router.delete("/api/session")
def sign_out(response: Response) -> Session:
    """Sign out."""
    response.delete_cookie(OPERATOR_COOKIE, httponly=True, samesite="strict")
    return Session(operator=None, version=__version__)


# Time limit for sending an event to a page; after that the page is disconnected.
SEND_WITHIN_S = 10.0
# Time limit for reading a locked project; a page tries again by itself.
CONNECT_WITHIN_S = 0.5
BAD_MESSAGE, TOO_SLOW = 1007, 1013


class Opened(Schema):
    """The page shows a frame."""

    type: Literal["open"]
    frame: RowId


class Closed(Schema):
    """The page no longer shows a frame."""

    type: Literal["close"]


PageMessage = TypeAdapter[Opened | Closed](Annotated[Opened | Closed, Field(discriminator="type")])


@router.websocket("/api/events")
async def events(
    socket: WebSocket, ctx: Ctx, operator: Operator, project: Annotated[str | None, Query(max_length=64)] = None
) -> None:
    """Sends events to a page, and receives which frame it shows."""
    if project is not None:
        await run_in_threadpool(_begin, ctx, project)
    # joined before the page knows that it is connected: what it reads from then on is followed by every later event
    client = Client(project, operator)
    ctx.hub.join(client)
    tasks = []
    try:
        await socket.accept()
        tasks = [asyncio.create_task(_send(socket, client)), asyncio.create_task(_receive(socket, ctx, client))]
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        ctx.hub.leave(client)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _begin(ctx: Context, project: str) -> None:
    # pages that connect again and again to a locked project must not occupy all threads
    with waiting_at_most(CONNECT_WITHIN_S):
        ctx.announcer.begin(ctx.project(project))


async def _send(socket: WebSocket, client: Client) -> None:
    try:
        while (text := await client.queue.get()) is not None:
            # unlike `wait_for`, without a task for each event
            async with asyncio.timeout(SEND_WITHIN_S):
                await socket.send_text(text)
        async with asyncio.timeout(SEND_WITHIN_S):
            await socket.close(TOO_SLOW)
    except (TimeoutError, WebSocketDisconnect, RuntimeError):  # disconnected during a send
        return


async def _receive(socket: WebSocket, ctx: Context, client: Client) -> None:
    try:
        while True:
            _handle(ctx, client, await socket.receive_text())
    except ValidationError:
        await socket.close(BAD_MESSAGE, "invalid message")
    except (WebSocketDisconnect, KeyError):  # KeyError: a binary message has no text
        return


def _handle(ctx: Context, client: Client, text: str) -> None:
    match PageMessage.validate_json(text):
        case Opened(frame=frame):
            ctx.hub.set_frame(client, frame)
        case Closed():
            ctx.hub.set_frame(client, None)
