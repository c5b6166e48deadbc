"""Requests that name another host, or come from another page."""

from __future__ import annotations

from typing import TYPE_CHECKING

import httpx
import pytest

if TYPE_CHECKING:
    from live_server import Live

REBOUND = [
    "evil.example",
    "127.0.0.1.evil.example",
    "localhost.evil.example",
    "0.0.0.0",
    "[::ffff:127.0.0.1]",
]


@pytest.mark.parametrize("host", REBOUND)
def test_a_name_that_was_rebound_to_this_machine_reads_nothing(live: Live, host: str) -> None:
    for path in ("/", "/api/projects", "/api/projects/room/frames/1"):
        answer = httpx.get(live.url + path, headers={"Host": host, "Cookie": live.cookies()})
        assert answer.status_code == 403, (path, host, answer.text)
        assert "room" not in answer.text
