"""Sign-in, missing resources, and the page's files."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from annotator import __version__

if TYPE_CHECKING:
    from live_server import Live


def test_sign_in_and_out(live: Live) -> None:
    client = live.client
    assert client.get("/api/session").json() == {"operator": "Ada", "version": __version__, "token_required": False}
    answer = client.post("/api/session", json={"operator": " Zoë Ångström "})
    assert answer.json()["operator"] == client.get("/api/session").json()["operator"] == "Zoë Ångström"
    assert "HttpOnly" in answer.headers["set-cookie"]
    assert "SameSite=strict" in answer.headers["set-cookie"]
    assert client.delete("/api/session").json()["operator"] is None
    assert client.get("/api/session").json()["operator"] is None


@pytest.mark.parametrize("name", ["", "  ", "a\nb", "x" * 65, 3, None])
def test_invalid_names_are_refused(live: Live, name: object) -> None:
    answer = live.client.post("/api/session", json={"operator": name})
    assert answer.status_code == 422
    assert answer.json()["error"]["kind"] == "ValidationError"
    assert "operator" in answer.json()["error"]["message"]


def test_unknown_paths_are_404(live: Live) -> None:
    for path in ("/api/nothing", "/nothing", "/assets/nothing.js", "/api/session/x"):
        answer = live.client.get(path)
        assert (answer.status_code, answer.json()["error"]["kind"]) == (404, "NotFoundError")
