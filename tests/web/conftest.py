"""A real server on 127.0.0.1 with a generated project, and clients of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
import pytest

from annotator.project import create_project
from annotator.recordings import open_recording
from annotator.web.settings import ServerSettings
from annotator.workflows.recordings import register_recording

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
        _wait_for(lambda: server.started, STARTS_WITHIN_S)
        with httpx.Client(base_url=url, headers={"Origin": url, **headers}, timeout=60.0) as client:
            if settings.token is not None:
                client.get("/", params={"token": settings.token})
            assert client.post("/api/session", json={"operator": OPERATOR}).status_code == 200
            yield Live(url, settings, client, server)
    finally:
        server.should_exit = True
        thread.join(STARTS_WITHIN_S)
        assert not thread.is_alive(), "the server does not end"


def _wait_for(true: Callable[[], Any], seconds: float) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "not within the time"
        time.sleep(0.01)


@pytest.fixture
def wait_for() -> Callable[[Callable[[], Any], float], None]:
    """`wait_for(condition, seconds)`: fails where it does not come true in time."""
    return _wait_for


@pytest.fixture
def web_settings(tmp_path: Path, generated: Path) -> ServerSettings:
    """Settings of a server whose project `room` has 5 frames of people (none labelled), folder root `generated`."""
    with create_project(tmp_path / "projects", "room", ("person",)) as project:
        register_recording(project, open_recording(generated / "people"))
    return ServerSettings(tmp_path / "projects", (generated,), port=0)


@pytest.fixture
def live(web_settings: ServerSettings) -> Iterator[Live]:
    """A server of one's own with the project `room`."""
    with running(web_settings) as server:
        yield server
