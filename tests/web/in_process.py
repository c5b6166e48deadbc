"""Requests to an application without a server, fast enough for large tables of cases."""

from __future__ import annotations

import asyncio
from itertools import count
from typing import Any

import httpx
from fastapi import FastAPI

HERE = "http://127.0.0.1"


# Each request comes from another address, so that the limits for each address do not apply.
ADDRESSES = (f"10.{number >> 16}.{number >> 8 & 255}.{number & 255}" for number in count())


def ask(
    app: FastAPI, method: str, path: str | httpx.URL, base: str = HERE, address: str | None = None, **request: Any
) -> httpx.Response:
    """Sends one request, from the given or another address."""

    async def asking() -> httpx.Response:
        sender = (address or next(ADDRESSES), 1)
        transport = httpx.ASGITransport(app, raise_app_exceptions=False, client=sender)
        cookies = request.pop("cookies", None)
        async with httpx.AsyncClient(transport=transport, base_url=base, cookies=cookies, trust_env=False) as client:
            return await client.request(method, path, **request)

    return asyncio.run(asking())


def open_socket(app: FastAPI, path: str, headers: dict[str, str]) -> int:
    """Requests a WebSocket; returns the status of the answer, 101 if accepted."""
    sent: list[Any] = []

    async def receive() -> dict[str, Any]:
        return {"type": "websocket.disconnect" if len(sent) else "websocket.connect", "code": 1000}

    async def send(message: Any) -> None:
        sent.append(message)

    scope = {
        "type": "websocket",
        "path": path,
        "raw_path": path.encode(),
        "query_string": b"",
        "root_path": "",
        "scheme": "ws",
        "server": ("127.0.0.1", 80),
        "client": (next(ADDRESSES), 1),
        "subprotocols": [],
        "state": {},
        "headers": [(name.lower().encode(), value.encode()) for name, value in headers.items()],
        "extensions": {"websocket.http.response": {}},
    }
    asyncio.run(app(scope, receive, send))
    first = sent[0]
    return {"websocket.accept": 101, "websocket.close": 403}.get(first["type"]) or int(first["status"])
