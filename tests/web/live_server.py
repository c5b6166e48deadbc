"""A real server in a thread, and a client of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import httpx
from websockets.sync.client import ClientConnection, connect

from annotator.web.security import ServerSettings

if TYPE_CHECKING:
    from annotator.web.context import Context
    from annotator.web.serve import Running

OPERATOR = "Ada"
# A limit for waits, which only a failure should reach, even on a slow or busy machine.
PATIENCE_S = 240.0


@dataclass(eq=False)
class Live:
    """A running server at `http://127.0.0.1:PORT`; its client is signed in as Ada, from the server's own page."""

    url: str
    settings: ServerSettings
    client: httpx.Client
    server: Running = field(repr=False)

    @property
    def context(self) -> Context:
        """The application's context."""
        context: Context = self.server.app.state.context
        return context

    def socket_url(self, path: str) -> str:
        """The address of a WebSocket."""
        return self.url.replace("http", "ws", 1) + path

    def listen(self, query: str = "?project=room", cookie: str | None = None, **how: Any) -> ClientConnection:
        """A socket of events, as from the server's own page; of the signed-in client unless another cookie is given."""
        headers = {"Cookie": self.cookies() if cookie is None else cookie}
        given = {"origin": self.url, **how}
        return connect(self.socket_url(f"/api/events{query}"), additional_headers=headers, **given)

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
        wait_until(lambda: server.started)
        with httpx.Client(base_url=url, headers={"Origin": url, **headers}, timeout=PATIENCE_S) as client:
            if settings.token is not None:
                client.get("/", params={"token": settings.token})
            assert client.post("/api/session", json={"operator": OPERATOR}).status_code == 200
            yield Live(url, settings, client, server)
    finally:
        server.should_exit = True
        thread.join(PATIENCE_S)
        assert not thread.is_alive(), "the server did not stop"


def look(live: Live, job_id: str) -> dict[str, Any]:
    """The current record of a job."""
    jobs: list[dict[str, Any]] = live.client.get("/api/jobs").json()
    return next(job for job in jobs if job["id"] == job_id)


def ended(live: Live, job: dict[str, Any]) -> dict[str, Any]:
    """Waits for the end of a job; returns its record."""
    end = time.monotonic() + PATIENCE_S
    while (now := look(live, job["id"]))["state"] in ("queued", "running"):
        assert time.monotonic() < end, now
        time.sleep(0.05)
    return now


def wait_until(true: Callable[[], Any]) -> None:
    """Waits for a condition; fails after a long time."""
    end = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < end, "not within the time"
        time.sleep(0.01)
