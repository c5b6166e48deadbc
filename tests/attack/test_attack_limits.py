"""Strangers who hold connections open, guess tokens, flood sockets and fill the log of a server with a token."""

from __future__ import annotations

import socket
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import httpx
import pytest
from live_server import PATIENCE_S, running, wait_until
from websockets.exceptions import ConnectionClosed, InvalidStatus

from annotator.project import create_project
from annotator.web import limits
from annotator.web.limits import BURST, FILE, limited_log
from annotator.web.security import GUESSES_BURST, ServerSettings

if TYPE_CHECKING:
    from live_server import Live


TOKEN = "a-token-for-the-attacks"
HALF = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Half: "
CONNECTIONS, GUESSES, MESSAGES, REFUSED = 1100, 300, 60_000, 300


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
        wait_until(lambda: config.open.silent == 0)
    assert log_of(locked) == ""


def test_tokens_cannot_be_guessed_fast(locked: Live) -> None:
    with httpx.Client(base_url=locked.url, timeout=PATIENCE_S) as guesser:
        said = Counter(guesser.get("/", params={"token": f"{number:021d}"}).status_code for number in range(GUESSES))
        assert set(said) == {401, 429}
        assert said[401] < 2 * GUESSES_BURST
        assert guesser.get("/", params={"token": TOKEN}).status_code == 429
    assert locked.client.get("/api/session").status_code == 200


def test_a_page_cannot_flood_the_others(locked: Live) -> None:
    with locked.listen() as loud:
        with suppress(ConnectionClosed):
            for _ in range(MESSAGES):
                loud.send('{"type": "open", "project": "room", "frame": 1}')
        with suppress(ConnectionClosed):
            while True:
                loud.recv(timeout=PATIENCE_S)
        # refused for its rate, or dropped because it does not read the answers
        assert loud.close_code in (1008, 1013)
    with locked.listen() as next_one:
        assert "presence" in next_one.recv(timeout=PATIENCE_S)


def test_refused_sockets_and_garbage_leave_few_lines(locked: Live) -> None:
    for number in range(REFUSED):
        with suppress(InvalidStatus), locked.listen(f"?project=none{number}"):
            raise AssertionError("there is no such project")
        with socket.create_connection(("127.0.0.1", locked.server.port), PATIENCE_S) as garbage:
            garbage.sendall(b"\0\r\n\r\n")
            with suppress(ConnectionError):
                while garbage.recv(4096):
                    pass
    said = log_of(locked)
    assert "Traceback" not in said
    assert len(said.splitlines()) < REFUSED / 2, f"{BURST} at once"
    assert locked.client.get("/api/session").status_code == 200
