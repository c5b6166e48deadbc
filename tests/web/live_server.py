"""A real server in a thread, and a client of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import httpx

from annotator.web.settings import ServerSettings

if TYPE_CHECKING:
    from annotator.web.context import Context
    from annotator.web.serve import Running

OPERATOR = "Ada"
STARTS_WITHIN_S = 20.0


@dataclass(eq=False)
class Live:
    """A running server.

    Attributes:
        url: `http://127.0.0.1:PORT`.
        settings: what it was told.
        client: signed in as Ada; asks from the server's own page.
    """

    url: str
    settings: ServerSettings
    client: httpx.Client
    server: Running = field(repr=False)

    @property
    def context(self) -> Context:
        """The application's context."""
        found: Context = self.server.app.state.context
        return found

    def socket_url(self, path: str) -> str:
        """The address of a WebSocket."""
        return self.url.replace("http", "ws", 1) + path

    def cookies(self) -> str:
        """The header `Cookie` of the signed-in client."""
        return "; ".join(f"{name}={value}" for name, value in self.client.cookies.items())


@contextmanager
def running(settings: ServerSettings, **headers: str) -> Iterator[Live]:
    """A server in a thread, and a client that has signed in."""
    from annotator.web.serve import Running

    server = Running(settings)
    thread = threading.Thread(target=server.serve_until_stopped, name="server")
    thread.start()
    url = f"http://127.0.0.1:{server.port}"
    try:
        wait_until(lambda: server.started, STARTS_WITHIN_S)
        with httpx.Client(base_url=url, headers={"Origin": url, **headers}, timeout=60.0) as client:
            if settings.token is not None:
                client.get("/", params={"token": settings.token})
            assert client.post("/api/session", json={"operator": OPERATOR}).status_code == 200
            yield Live(url, settings, client, server)
    finally:
        server.should_exit = True
        thread.join(STARTS_WITHIN_S)
        assert not thread.is_alive(), "the server does not end"


def ended(live: Live, job: dict[str, Any], seconds: float = 60.0) -> dict[str, Any]:
    """A job once it has come to its end."""
    end = time.monotonic() + seconds
    while (now := live.client.get(f"/api/jobs/{job['id']}").json())["state"] in ("queued", "running"):
        assert time.monotonic() < end, now
        time.sleep(0.05)
    found: dict[str, Any] = now
    return found


def wait_until(true: Callable[[], Any], seconds: float) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "not within the time"
        time.sleep(0.01)
