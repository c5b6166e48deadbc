"""Cookies that nobody was given, on a server without and with a token."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from live_server import running
from raw import request, require_alive

from annotator.project import open_project
from annotator.web.security import ServerSettings, cookie_name

if TYPE_CHECKING:
    from live_server import Live

TOKEN = "the-token-of-this-attack"
HOSTILE = {
    "control characters": "Ada%00%0a%1b%5b31m",
    "6,000 letters": "a" * 6000,
    "broken escapes": "%zz%",
    "surrogates": "%ed%a0%80",
    "direction": "%e2%80%ae%e2%80%8b",
    "script": "%3Cscript%3Ealert(1)%3C/script%3E",
    "quotes": '"\\"',
    "bytes": "\xff\xfe",
    "equals": "=;=;=",
}


def _others(live: Live) -> str:
    """The token's cookie, without the operator's."""
    return "; ".join(f"{name}={value}" for name, value in live.client.cookies.items() if name != "annotator_operator")


@pytest.mark.parametrize("cookie", HOSTILE.values(), ids=HOSTILE)
def test_an_operator_that_could_not_sign_in_is_no_author(live: Live, cookie: str) -> None:
    given = {"Cookie": "; ".join(filter(None, [_others(live), f"annotator_operator={cookie}"]))}
    for method, path, body in (
        ("GET", "/api/session", b""),
        ("GET", "/api/projects/room/frames/1", b""),
        (
            "POST",
            "/api/projects/room/frames/1/changes",
            b'{"revision": 0, "changes": [{"kind": "finalise"}]}',
        ),
    ):
        status, answer = request(live, method, path, body, given)
        assert status < 500, (path, answer)
    with open_project(live.settings.projects_root / "room") as project:
        authors = {event.author for event in project.log.since()}
    assert all(author.isprintable() and len(author) <= 64 for author in authors), authors
    require_alive(live)


def test_cookies_do_not_stand_in_for_the_token(web_settings: ServerSettings) -> None:
    locked = ServerSettings(web_settings.projects_root, web_settings.folders, port=0, token=TOKEN)
    name = cookie_name(TOKEN)
    with running(locked) as live:
        for cookie in (
            "",
            "annotator_operator=Ada",
            f"{name}=",
            f"{name}={TOKEN[:-1]}",
            f"{name}={TOKEN}x",
            f"{name.upper()}={TOKEN}",
            f"{name}=%74{TOKEN[1:]}",
            f'{name}="{TOKEN}x"',
            f"annotator_token={TOKEN}",
            f"token={TOKEN}",
            f"{name}={'a' * 4000}",
            f"{name}={TOKEN}\xff",
            f"{name}={TOKEN}; {name}=wrong",
        ):
            for path in ("/api/projects", "/", "/api/projects/room/frames/1/image.jpg"):
                status, answer = request(live, "GET", path, headers={"Cookie": cookie})
                assert status in (400, 401), (cookie, path, status)
                assert b"room" not in answer and TOKEN.encode() not in answer
        for more in ({"Authorization": f"Bearer {TOKEN}x"}, {"X-Token": TOKEN}, {"Referer": f"/?token={TOKEN}"}):
            assert request(live, "GET", "/api/projects", headers={"Cookie": "", **more})[0] == 401
        require_alive(live)


def test_the_cookies_cannot_be_read_by_scripts_or_sent_by_other_sites(live: Live) -> None:
    answer = live.client.post("/api/session", json={"operator": "Ada <b>;=, \\ é 😀"})
    assert answer.status_code == 200
    words = answer.headers["set-cookie"].lower()
    assert "httponly" in words and "samesite=strict" in words and "<b>" not in words
    assert live.client.get("/api/session").json()["operator"] == "Ada <b>;=, \\ é 😀"
