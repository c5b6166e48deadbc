"""Bounds how many threads of the server one project may occupy, so that a locked one leaves some to the others."""

from __future__ import annotations

import asyncio
import re
from dataclasses import dataclass, field

from starlette.types import ASGIApp, Message, Receive, Scope, Send

# The server has 40 threads (AnyIO's default), and a project 20 connections to its database.
AT_ONCE = 12

_PROJECT = re.compile(r"/api/projects/([^/]+)")


@dataclass(eq=False)
class _Gate:
    """Of one project; `users`: requests that wait or are worked on."""

    free: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(AT_ONCE))
    users: int = 0


class Fair:
    """ASGI middleware: requests to a project beyond the bound wait in the event loop, not in a thread."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app
        self._gates: dict[str, _Gate] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a request on when its project is below the bound."""
        found = _PROJECT.match(scope["path"]) if scope["type"] == "http" else None
        if found is None:
            await self.app(scope, receive, send)
            return
        name = found[1]
        gate = self._gates.setdefault(name, _Gate())
        gate.users += 1
        try:
            await self._pass_on(gate, scope, receive, send)
        finally:
            gate.users -= 1
            if not gate.users:
                del self._gates[name]

    async def _pass_on(self, gate: _Gate, scope: Scope, receive: Receive, send: Send) -> None:
        await gate.free.acquire()
        held = True

        def release() -> None:
            nonlocal held
            if held:
                held = False
                gate.free.release()

        async def sending(message: Message) -> None:
            # the work is done; a slow download must not count
            release()
            await send(message)

        try:
            await self.app(scope, receive, sending)
        finally:
            release()
