"""Requests that name another host, or come from another page."""

from __future__ import annotations

from typing import TYPE_CHECKING

import httpx
import pytest
from attacks import request, require_alive, send
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

if TYPE_CHECKING:
    from live_server import Live

REBOUND = [
    "evil.example",
    "127.0.0.1.evil.example",
    "localhost.evil.example",
    "0.0.0.0",
    "[::ffff:127.0.0.1]",
    "2130706433",
    "127.1",
    "localhost\t.evil.example",
]
ORIGINS = ["null", "", "http://127.0.0.1", "http://127.0.0.1:1", "http://evil.example", "file://", "data:", "*"]


def test_a_name_that_was_rebound_to_this_machine_reads_and_changes_nothing(live: Live) -> None:
    for host in REBOUND:
        for path in ("/", "/api/projects", "/api/projects/room/frames/1", "/assets/js/main.js"):
            for more in ("", live.url.rpartition(":")[2]):
                status, answer = request(live, "GET", path, headers={"Host": f"{host}:{more}" if more else host})
                assert status in (400, 403), (path, host, answer)
                assert b"room" not in answer
        # the attacker's own page sends its own name in both
        asked = {"Host": host, "Origin": f"http://{host}"}
        assert request(live, "POST", "/api/projects/room/undo", b"{}", asked)[0] in (400, 403)
    require_alive(live)


def test_two_hosts_no_host_or_an_absolute_target_do_not_confuse_the_check(live: Live) -> None:
    here, cookie = live.url.removeprefix("http://"), live.cookies()
    for lines in (
        f"GET /api/projects HTTP/1.1\r\nHost: evil.example\r\nHost: {here}\r\n",
        f"GET /api/projects HTTP/1.1\r\nHost: {here}\r\nHost: evil.example\r\n",
        "GET /api/projects HTTP/1.1\r\n",
        "GET /api/projects HTTP/1.0\r\n",
        "GET http://evil.example/api/projects HTTP/1.1\r\nHost: evil.example\r\n",
        f"GET /api/projects HTTP/1.1\r\nHost: evil.example\r\nX-Forwarded-Host: {here}\r\n",
        f"GET /api/projects HTTP/1.1\r\nHost: evil.example\r\nForwarded: host={here}\r\n",
        "GET /api/projects HTTP/1.1\r\nHost: evil.example\r\nX-Forwarded-For: 127.0.0.1\r\n",
        f"GET /api/projects HTTP/1.1\r\nHost : {here}\r\n",
        f"GET /api/projects HTTP/1.1\r\n Host: {here}\r\n",
    ):
        status, answer = send(live, f"{lines}Cookie: {cookie}\r\nConnection: close\r\n\r\n".encode())
        assert status in (400, 403), (lines, answer)
        assert b"room" not in answer


@pytest.mark.parametrize("origin", ORIGINS)
def test_a_foreign_page_changes_nothing(live: Live, origin: str) -> None:
    before = live.client.get("/api/projects/room/frames/1").json()
    asked = {"Origin": origin, "Cookie": live.cookies()}
    port = live.url.rpartition(":")[2]
    places = [
        ("POST", "/api/projects/room/frames/1/changes"),
        ("POST", "/api/projects"),
        ("PATCH", "/api/projects/room"),
    ]
    places += [("POST", "/api/session"), ("DELETE", "/api/session"), ("PUT", "/api/projects/room/models/learning")]
    for method, path in places:
        for text in ("application/json", "text/plain", "application/x-www-form-urlencoded"):
            # what forms of other pages can send without asking first
            answer = httpx.request(method, live.url + path, content="{}", headers={**asked, "Content-Type": text})
            assert answer.status_code == 403, (path, answer.text)
            assert "access-control-allow-origin" not in answer.headers
    preflight = httpx.options(live.url + "/api/projects", headers={**asked, "Access-Control-Request-Method": "POST"})
    assert "access-control-allow-origin" not in preflight.headers
    for path in ("/api/events?project=room", "/viser/1"):
        with (
            pytest.raises(InvalidStatus) as refused,
            connect(
                f"ws://127.0.0.1:{port}{path}",
                additional_headers={"Cookie": live.cookies()},
                origin=origin or None,  # type: ignore[arg-type]
            ),
        ):
            pass
        assert refused.value.response.status_code == 403
    assert live.client.get("/api/projects/room/frames/1").json() == before
