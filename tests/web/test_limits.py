"""Connections that send slowly, too many of them, and a log that stays small."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from live_server import PATIENCE_S, running, wait_until

from annotator.project import create_project
from annotator.web import limits
from annotator.web.limits import FILE, MOST_KEYS, Connections, Rate, address_key, limited_log
from annotator.web.security import ServerSettings

if TYPE_CHECKING:
    from live_server import Live

HEAD = b"POST /api/session HTTP/1.1\r\nHost: 127.0.0.1\r\n"
TOKEN = "a-token-for-the-tests"


@pytest.fixture
def locked(tmp_path: Path) -> Iterator[Live]:
    """A server with a token, and room for 16 connections: 12 silent ones, 8 of them from one address."""
    create_project(tmp_path / "projects", "room", ("person",)).close()
    with running(ServerSettings(tmp_path / "projects", port=0, token=TOKEN)) as live:
        connections_of(live).__init__(16)  # type: ignore[misc]
        yield live


def wait_for(find: Callable[[], Any]) -> Any:
    wait_until(find)
    return find()


def connections_of(live: Live) -> Connections:
    config = live.server.config
    assert isinstance(config, limits.LimitedConfig)
    return config.open


def dial(live: Live) -> socket.socket:
    return socket.create_connection(("127.0.0.1", live.server.port), timeout=PATIENCE_S)


def rest(connection: socket.socket) -> bytes:
    """What the server sends until it closes the connection."""
    parts = []
    with suppress(ConnectionError):
        while part := connection.recv(65536):
            parts.append(part)
    return b"".join(parts)


@pytest.mark.parametrize(
    ("sent", "more"),
    [(b"", b""), (HEAD, b"X-Slow: yes\r\n")],
    ids=["nothing", "drop by drop"],
)
def test_headers_must_come_in_time(locked: Live, monkeypatch: pytest.MonkeyPatch, sent: bytes, more: bytes) -> None:
    monkeypatch.setattr(limits, "HEADERS_WITHIN_S", 0.2)
    with dial(locked) as slow:
        slow.sendall(sent)
        slow.settimeout(0.05)
        while True:
            try:
                assert slow.recv(1) == b""
                break
            except TimeoutError:
                slow.sendall(more)
            except ConnectionError:
                break
    monkeypatch.undo()
    assert locked.client.get("/api/session").status_code == 200


def test_headers_of_a_second_request_must_come_in_time(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "HEADERS_WITHIN_S", 0.2)
    with dial(live) as slow:
        slow.sendall(b"GET /api/session HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        slow.recv(65536)
        slow.sendall(b"GET /api/session HTTP/1.1\r\n")
        assert b"HTTP/1.1" not in rest(slow)


def test_bodies_must_make_progress(live: Live) -> None:
    head = HEAD + f"Origin: http://127.0.0.1\r\nContent-Length: {10**6}\r\n\r\n".encode()
    with dial(live) as slow:
        slow.sendall(head)
        (protocol,) = wait_for(
            lambda: [each for each in live.server.server_state.connections if each._awaited == "body"]
        )
        slow.sendall(b" " * limits.BODY_BYTES)
        wait_until(lambda: protocol._received >= limits.BODY_BYTES)
        protocol.loop.call_soon_threadsafe(protocol._too_late)
        wait_until(lambda: protocol._received == 0)
        assert not protocol.transport.is_closing(), "it has brought enough"
        protocol.loop.call_soon_threadsafe(protocol._too_late)
        assert rest(slow) == b"", "nothing came since"


class Transport(asyncio.Transport):
    closed = False

    def abort(self) -> None:
        self.closed = True


def test_room_is_kept_for_those_who_have_signed_in() -> None:
    connections = Connections(8)  # 6 silent ones, 4 of an address

    def arrive(*addresses: str) -> list[Transport]:
        new = [Transport() for _ in addresses]
        for address, transport in zip(addresses, new, strict=True):
            connections.arrive(address, transport)
        return new

    known = arrive("a", "b", "c", "d")
    for transport in known:
        connections.heard(transport)
    silent = arrive("e", "f", "g", "h", "i")
    assert [transport.closed for transport in silent] == [True, False, False, False, False], "room for 8"
    more = arrive("j", "k", "l", "m")
    for transport in more:
        connections.heard(transport)
    assert not any(transport.closed for transport in [*known, *more])
    assert (len(connections), connections.silent) == (8, 0)
    assert arrive("n")[0].closed, "there is no silent one to turn out"
    for transport in [*known, *more]:
        connections.leave(transport)
    assert len(connections) == 0 and not connections._silent_of
    silent = arrive("o", "p", "q", "q", "q", "q", "q")
    assert [transport.closed for transport in silent] == [False] * 2 + [True] + [False] * 4, "room for 4 of an address"
    assert [transport.closed for transport in [*arrive("r"), silent[0]]] == [False, True], "room for 6 silent ones"


def test_rates_refill_and_forget() -> None:
    now = 0.0
    rate = Rate(2.0, 3, clock=lambda: now)
    assert [rate.take("a") for _ in range(4)] == [True, True, True, False]
    assert rate.take("b") and not rate.allows("a")
    assert rate.wait_s("a") == 0.5
    now = 1.0
    assert [rate.take("a") for _ in range(3)] == [True, True, False]
    for key in range(MOST_KEYS + 10):
        rate.take(key)
    assert len(rate._left) == MOST_KEYS


def test_addresses_of_one_network_count_as_one() -> None:
    assert address_key("10.0.0.1") == address_key("::ffff:10.0.0.1") == "10.0.0.1"
    assert address_key("2001:db8:0:1:2::3") == "2001:db8:0:1::/64"
    assert (address_key("fe80::1%eth0"), address_key("testclient"), address_key("")) == ("fe80::/64", "testclient", "")


def test_the_log_has_few_lines_and_rotates(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(limits, "FILE_BYTES", 2000)
    # time stands still: on a slow machine, more lines would be allowed meanwhile
    monkeypatch.setattr(limits, "Rate", partial(Rate, clock=lambda: 0.0))
    logger = logging.getLogger("uvicorn.error")
    with limited_log(tmp_path):
        for number in range(1000):
            logger.warning("Invalid HTTP request %d received.", number)
        logger.warning("another place: %s", "x" * 3000)
    said = capsys.readouterr().err
    assert said.count("Invalid HTTP") == limits.BURST
    assert "another place" in said
    files = sorted(tmp_path.iterdir())
    assert [file.name for file in files] == [FILE, f"{FILE}.1"]
    assert {file.stat().st_mode & 0o777 for file in files} == {0o600}
    logger.warning("after the end")
    assert "after the end" not in (tmp_path / FILE).read_text()


def test_the_log_says_how_much_it_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    few, now = limits.FewLines(), 0.0
    few._rate = Rate(1.0, 2, clock=lambda: now)

    def said(text: str) -> str | None:
        record = logging.LogRecord("a", logging.WARNING, "a.py", 1, "%s", (text,), None)
        return record.getMessage() if few.filter(record) else None

    assert [said(str(number)) for number in range(5)] == ["0", "1", None, None, None]
    now = 2.0
    assert said("5") == "5 (and 3 more like this, left out)"
