"""WebSockets: malformed and endless messages, readers that do not read; and connections that are held open."""

from __future__ import annotations

import json
import socket
import struct
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import httpx
import pytest
from attacks import unharmed
from live_server import PATIENCE_S, running, wait_until
from websockets.exceptions import ConnectionClosed

from annotator.project import create_project
from annotator.web import limits
from annotator.web.limits import FILE, limited_log
from annotator.web.security import ServerSettings

if TYPE_CHECKING:
    from live_server import Live


OPEN = {"type": "open", "frame": 1}


@pytest.fixture
def live(live: Live) -> Iterator[Live]:
    """A server that still answers, sends events and has not grown after each test."""
    with unharmed(live):
        yield live
        with live.listen() as events:
            events.send(json.dumps(OPEN))
            assert "presence" in events.recv(timeout=PATIENCE_S)


MESSAGES: dict[str, str | bytes] = {
    "binary": b"\0\1\2",
    "deep": "[" * 100_000,
    "more": json.dumps({**OPEN, "operator": "root"}),
    "large": json.dumps({**OPEN, "project": "a" * 900_000}),
    "too large": "a" * (20 << 20),
    "frame": json.dumps({**OPEN, "frame": 2**53}),
}


@pytest.mark.parametrize("message", MESSAGES.values(), ids=MESSAGES)
def test_a_malformed_message_ends_its_own_connection_at_most(live: Live, message: str | bytes) -> None:
    with live.listen() as other, live.listen() as events:
        try:
            events.send(message)
            events.ping().wait(5.0)
        except ConnectionClosed:
            pass
        other.send(json.dumps(OPEN))
        while "Ada" not in other.recv(timeout=PATIENCE_S):
            pass


def test_frames_that_break_the_protocol_end_their_own_connection_at_most(live: Live) -> None:
    host, port = live.url.removeprefix("http://").split(":")
    head = (
        f"GET /api/events?project=room HTTP/1.1\r\nHost: {host}:{port}\r\nOrigin: {live.url}\r\n"
        f"Cookie: {live.cookies()}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    ).encode()
    for frame in (
        b"\x81\x05hello",  # without a mask
        b"\xff\x80\0\0\0\0",  # reserved bits and opcode
        b"\x81\xff" + struct.pack(">Q", 2**63 - 1) + b"\0\0\0\0a",  # 8 exabytes are announced
        b"\x89\xfe\xff\xff\0\0\0\0" + b"a" * 70_000,  # a long ping
        b"\x80\x80\0\0\0\0",  # the end of nothing
        b"\x81\x84\0\0\0\0\xff\xfe\xfd\xfc",  # no UTF-8
        b"\x88\x82\0\0\0\0\x00\x01",  # an invalid reason to close
        b"\x01\x81\0\0\0\0[" * 50_000,  # a message in parts without end
        b"\x00" * 10_000,
    ):
        with socket.create_connection((host, int(port)), timeout=PATIENCE_S) as raw:
            raw.sendall(head)
            assert raw.recv(4096).startswith(b"HTTP/1.1 101")
            with suppress(OSError):  # it has been closed already
                raw.sendall(frame)


TOKEN = "a-token-for-the-attacks"
HALF = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Half: "
CONNECTIONS = 1100


@pytest.fixture
def locked(tmp_path: Path) -> Iterator[Live]:
    """A server with a token, and its log in `tmp_path`."""
    create_project(tmp_path / "projects", "room", ("person",)).close()
    settings = ServerSettings(tmp_path / "projects", port=0, token=TOKEN)
    with limited_log(tmp_path), running(settings) as live:
        yield live


def log_of(live: Live) -> str:
    return (live.settings.projects_root.parent / FILE).read_text()


def test_half_sent_requests_do_not_stop_the_server(locked: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    config = locked.server.config
    assert isinstance(config, limits.LimitedConfig)
    with ExitStack() as stack:
        for _ in range(CONNECTIONS):
            half = stack.enter_context(socket.create_connection(("127.0.0.1", locked.server.port), PATIENCE_S))
            half.sendall(HALF)
        # those who have signed in are served over old and over new connections
        assert locked.client.get("/api/projects/room").status_code == 200
        assert httpx.get(f"{locked.url}/api/session", cookies=locked.client.cookies, timeout=60).status_code == 200
        wait_until(lambda: not config.open._silent)
    assert log_of(locked) == ""
