"""Access: every route without the token, foreign pages and hosts, large bodies and headers; where the token comes from,
who may read what the server writes; and messages, which name files but not their folders on the server.
"""

from __future__ import annotations

import os
import re
import shutil
import socket
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

import httpx
import pytest
import schemathesis
from fastapi import FastAPI
from hypothesis import HealthCheck, Phase, given, settings
from in_process import HERE, ask, open_socket
from live_server import PATIENCE_S, ended, running
from starlette.routing import BaseRoute
from websockets.exceptions import ConnectionClosed, InvalidStatus

from annotator import __version__
from annotator.project import BoxRotation, ProjectSettings, create_project
from annotator.recordings import open_recording
from annotator.types.errors import ConfigError
from annotator.web import security
from annotator.web.app import create_app
from annotator.web.errors import hide_paths, without_commands
from annotator.web.jobs.records import WORK
from annotator.web.limits import Rate
from annotator.web.security import (
    BODY_LIMIT,
    GUESSES_BURST,
    MESSAGES_BURST,
    STRANGERS_BURST,
    VARIABLE,
    ServerSettings,
    check_settings,
    cookie_name,
    state_folder,
    with_token,
)
from annotator.workflows.add_recordings import add_recordings, register_recording
from annotator.workflows.recorded.own_labels import import_own_labels

if TYPE_CHECKING:
    from live_server import Live


TOKEN = "a-token-for-the-tests"
SECRET = "the-value-of-its-cookie"
NAME = cookie_name("127.0.0.1")


def flat(routes: Iterable[BaseRoute]) -> Iterator[tuple[str, str]]:
    """(method, path) of every route, with values for its parameters; the method of a WebSocket is WS."""
    for route in routes:
        inner = getattr(route, "original_router", None)
        if inner is not None:
            yield from flat(inner.routes)
            continue
        path = re.sub(r"\{[^}]*\}", "1", route.path)
        methods = getattr(route, "methods", None)
        if "Mount" in type(route).__name__:
            yield from (("GET", f"{path}/{name}") for name in ("index.html", "js/main.js", "nothing"))
        elif methods is None:
            yield "WS", path
        else:
            yield from ((method, path) for method in methods)


def headers(cookies: dict[str, str], origin: str | None) -> dict[str, str]:
    found = {"Host": "127.0.0.1", "Cookie": "; ".join(f"{name}={value}" for name, value in cookies.items())}
    return found if origin is None else {**found, "Origin": origin}


def locked(tmp: Path) -> FastAPI:
    return create_app(ServerSettings(tmp / "projects", token=TOKEN, cookie=SECRET))


@pytest.fixture(scope="module")
def app(tmp_path_factory: pytest.TempPathFactory) -> FastAPI:
    return locked(tmp_path_factory.mktemp("web"))


ROUTES = sorted(set(flat(locked(Path("/nowhere")).routes)))


def test_all_routes_need_the_token(app: FastAPI) -> None:
    assert {("GET", "/"), ("GET", "/assets/js/main.js"), ("GET", "/viser/1/1"), ("WS", "/viser/1")} <= set(ROUTES)
    assert len(ROUTES) > 60
    operator = {"annotator_operator": "Ada"}
    for method, path in ROUTES:
        if method == "WS":
            assert open_socket(app, path, headers(operator, HERE)) == 401
            continue
        answer = ask(app, method, path, headers=headers(operator, HERE))
        assert answer.status_code == 401, path
        assert method == "HEAD" or answer.json()["error"]["kind"] == "NotSignedInError"
    for cookies in ({NAME: TOKEN}, {NAME: ""}, {cookie_name("127.0.0.1:81"): SECRET}):
        asked = headers({**cookies, **operator}, HERE)
        assert open_socket(app, "/api/events", asked) == ask(app, "GET", "/", headers=asked).status_code == 401


def test_requests_from_foreign_pages_are_refused(app: FastAPI) -> None:
    def refuses(method: str, path: str, origin: str | None) -> None:
        asked = headers({NAME: SECRET, "annotator_operator": "Ada"}, origin)
        if method == "WS":
            assert open_socket(app, path, asked) == 403
            return
        answer = ask(app, method, path, headers=asked)
        assert (answer.status_code, answer.json()["error"]["kind"]) == (403, "ForbiddenError"), path

    for method, path in ROUTES:
        if method not in ("GET", "HEAD"):
            refuses(method, path, "http://evil.example")
    foreign = ("http://127.0.0.1:81", "https://127.0.0.1.evil.example", "null", "", "127.0.0.1", None)
    for origin in foreign:
        refuses("POST", "/api/session", origin)
        refuses("WS", "/api/events", origin)


def test_a_local_server_accepts_only_local_host_names(tmp_path: Path) -> None:
    app = create_app(ServerSettings(tmp_path))
    names = ("evil.example", "127.0.0.1.evil.example", "localhost.evil.example", "", "[", "a@b")
    for host in (*names, "0.0.0.0", "[::ffff:127.0.0.1]", "2130706433", "127.1", "localhost\t.evil.example"):
        answer = ask(app, "GET", "/api/session", headers={"Host": host})
        assert (answer.status_code, answer.json()["error"]["kind"]) == (403, "ForbiddenError")
    for host in ("127.0.0.1", "127.0.0.1:8080", "localhost:1", "LOCALHOST", "[::1]:8080"):
        assert ask(app, "GET", "/api/session", headers={"Host": host}).status_code == 200


def test_on_other_addresses_the_token_permits_any_host_name(tmp_path: Path) -> None:
    app = create_app(ServerSettings(tmp_path, host="0.0.0.0", token=TOKEN, cookie=SECRET))
    answer = ask(app, "GET", "/api/session", "http://workstation:8080", cookies={"annotator_8080": SECRET})
    assert answer.status_code == 200


def test_the_link_sets_a_cookie(app: FastAPI) -> None:
    answer = ask(app, "GET", "/", params={"token": TOKEN, "go": "room/annotate"})
    assert answer.status_code == 200
    assert TOKEN not in answer.text
    assert "url=/#/room/annotate" in answer.text
    assert "<script" not in answer.text
    cookie = answer.headers["set-cookie"]
    assert "httponly" in cookie.lower()
    assert "samesite=strict" in cookie.lower()
    kept = dict([cookie.split(";")[0].split("=")])
    assert ask(app, "GET", "/api/session", cookies=kept).status_code == 200
    assert ask(app, "POST", "/api/session", params={"token": TOKEN}, headers={"Origin": HERE}).status_code == 401
    assert ask(app, "GET", "/assets/js/main.js", cookies=kept).status_code == 200
    assert open_socket(app, "/api/events", headers(kept, HERE)) == 403, "no operator is signed in"
    assert open_socket(app, "/api/events", headers({**kept, "annotator_operator": "Ada"}, HERE)) == 101


def test_the_link_leads_only_to_parts_of_the_page(app: FastAPI) -> None:
    for go in ("//evil.example", "room/../x", 'x"><script>', "room/annotate#", "javascript:alert(1)", ""):
        assert 'url=/"' in ask(app, "GET", "/", params={"token": TOKEN, "go": go}).text
    # the link of an earlier start leads a known browser to the page, too
    answer = ask(
        app, "GET", "/", params={"token": "of-an-earlier-start", "go": "room/annotate"}, cookies={NAME: SECRET}
    )
    assert "url=/#/room/annotate" in answer.text


def test_few_tokens_can_be_guessed_and_few_requests_sent_without_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # time stands still: on a slow machine, as many requests as come in would be allowed again
    monkeypatch.setattr(security, "Rate", partial(Rate, clock=lambda: 0.0))
    app = locked(tmp_path)
    guesser = {"address": "2001:db8::1", "params": {"token": "a" * len(TOKEN)}}
    statuses = [ask(app, "GET", "/", **guesser).status_code for _ in range(GUESSES_BURST + 5)]
    assert statuses == [401] * GUESSES_BURST + [429] * 5
    # the right one is not told apart any more: not from the same network, but from others
    right = {"params": {"token": TOKEN}}
    assert ask(app, "GET", "/", address="2001:db8::2", **right).status_code == 429
    assert ask(app, "GET", "/", address="2001:db8:1::1", **right).status_code == 200
    assert ask(app, "GET", "/", address="2001:db8::1", cookies={NAME: SECRET}).status_code == 200
    statuses = [ask(app, "GET", "/api/session", address="10.9.9.9").status_code for _ in range(STRANGERS_BURST + 20)]
    assert set(statuses[:STRANGERS_BURST]) == {401}
    assert statuses[-1] == 429


def test_other_addresses_need_a_token(tmp_path: Path) -> None:
    local = ["127.0.0.1", "127.9.9.9", "::1", "localhost", "LocalHost"]
    for host, token in (*((host, None) for host in local), ("127.0.0.1", TOKEN), ("0.0.0.0", TOKEN)):
        check_settings(ServerSettings(tmp_path, host=host, token=token))
    foreign = ["0.0.0.0", "::", "192.168.0.1", "workstation", "localhost.example", "", "127.0.0.1.example"]
    weak = (("0.0.0.0", "short"), ("0.0.0.0", ""), ("127.0.0.1", "ü" * 20))
    for host, token in (*((host, None) for host in foreign), *weak):
        with pytest.raises(ConfigError):
            create_app(ServerSettings(tmp_path, host=host, token=token))


def test_responses_have_security_headers(live: Live) -> None:
    for path in ("/", "/assets/js/main.js", "/api/session", "/api/nothing", "/api/openapi.json"):
        headers = live.client.get(path).headers
        policy = headers["content-security-policy"]
        assert "default-src 'self'" in policy
        assert "frame-ancestors 'self'" in policy
        assert "unsafe-inline" not in policy.split("style-src")[0]
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"
        assert "server" not in headers
        if path.startswith("/api/"):
            assert headers["cache-control"] == "no-store"


def test_large_bodies_are_refused(live: Live) -> None:
    small = b'{"operator": "' + b"a" * (BODY_LIMIT - 100) + b'"}'
    large = b" " * (BODY_LIMIT + 1)
    assert live.client.post("/api/session", content=small).status_code == 422
    declared = live.client.post("/api/session", content=large)
    assert (declared.status_code, declared.json()["error"]["kind"]) == (413, "TooLargeError")
    streamed = live.client.post("/api/session", content=(large[i : i + 65536] for i in range(0, len(large), 65536)))
    assert streamed.status_code == 413
    assert live.client.get("/api/session").status_code == 200


def test_a_chunked_body_without_end_is_cut_off(live: Live) -> None:
    host, port = live.url.removeprefix("http://").split(":")
    head = (
        f"POST /api/session HTTP/1.1\r\nHost: {host}:{port}\r\nOrigin: {live.url}\r\nTransfer-Encoding: chunked\r\n\r\n"
    )
    chunk = b"10000\r\n" + b" " * 65536 + b"\r\n"
    with socket.create_connection((host, int(port)), timeout=PATIENCE_S) as raw:
        raw.sendall(head.encode())
        sent = 0
        try:
            while sent < 1024 * len(chunk):
                raw.sendall(chunk)
                sent += len(chunk)
        except OSError:
            pass  # the server has closed the connection
        assert sent < 1024 * len(chunk), "the server read 64 MiB"


def test_an_unexpected_error_reveals_no_details(tmp_path: Path) -> None:
    app = create_app(ServerSettings(tmp_path))

    def broken() -> None:
        raise RuntimeError("the secret")

    app.add_api_route("/api/broken", broken)
    app.router.routes.insert(0, app.router.routes.pop())
    answer = ask(app, "GET", "/api/broken")
    assert answer.status_code == 500
    assert answer.json()["error"] == {"kind": "InternalError", "message": "internal error, see the server's log"}
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_a_socket_that_a_route_refuses_logs_nothing(live: Live, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(InvalidStatus) as refused, live.listen("?project=nothing"):
        pass
    assert refused.value.response.status_code == 403
    live.client.get("/api/session")
    assert caplog.records == []


def test_a_page_that_sends_too_many_messages_is_disconnected(live: Live) -> None:
    # one of no project, whose message causes no event: a page that does not read its events is disconnected for that
    with live.listen("") as socket_:
        with suppress(ConnectionClosed):
            for _ in range(3 * MESSAGES_BURST):
                socket_.send('{"type": "close"}')
        with pytest.raises(ConnectionClosed):
            while True:
                socket_.recv(timeout=PATIENCE_S)
    assert socket_.close_code == 1008
    assert live.client.get("/api/session").status_code == 200


def test_sign_in_and_out(live: Live) -> None:
    client = live.client
    assert client.get("/api/session").json() == {"operator": "Ada", "version": __version__}
    answer = client.post("/api/session", json={"operator": " Zoë Ångström "})
    assert answer.json()["operator"] == client.get("/api/session").json()["operator"] == "Zoë Ångström"
    assert "HttpOnly" in answer.headers["set-cookie"]
    assert "SameSite=strict" in answer.headers["set-cookie"]
    for name in ("  ", "a\nb", "x" * 65, None):
        refused = client.post("/api/session", json={"operator": name})
        assert (refused.status_code, refused.json()["error"]["kind"]) == (422, "ValidationError")
    for cookie in ("%20", "a%0ab", "%ed%a0%80", "x" * 65):  # that nobody was given
        answer = httpx.get(f"{live.url}/api/session", headers={"Cookie": f"annotator_operator={cookie}"})
        assert (answer.status_code, answer.json()["operator"]) == (200, None)
    assert client.delete("/api/session").json()["operator"] is None
    assert client.get("/api/session").json()["operator"] is None


LONG = "a-token-from-the-operator"


@pytest.fixture(autouse=True)
def _state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


def token_file(folder: Path, content: str, mode: int = 0o600) -> Path:
    path = folder / "token"
    path.write_text(content)
    path.chmod(mode)
    return path


def test_every_address_has_a_new_token_unless_one_is_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here, there = ServerSettings(tmp_path), ServerSettings(tmp_path, host="192.168.0.9")
    tokens = [with_token(settings).token for settings in (here, here, there, there)]
    assert len(set(tokens)) == 4
    assert all(token is not None and len(token) == 43 for token in tokens)
    assert with_token(here, token_file(tmp_path, f"{LONG}\n")).token == LONG
    monkeypatch.setenv(VARIABLE, LONG)
    assert with_token(there).token == LONG
    assert VARIABLE not in os.environ, "jobs would inherit it"
    assert with_token(here, no_token=True).token is None


@pytest.mark.parametrize(
    ("content", "mode", "said"),
    [
        (LONG, 0o644, "other users may read it; run chmod 600"),
        ("two words", 0o600, "is not one line with a token"),
        ("x" * 5000, 0o600, "is not one line with a token"),
        ("ü" * 20, 0o600, "a token needs at least 16 ASCII"),
    ],
)
def test_unusable_token_files_are_errors(tmp_path: Path, content: str, mode: int, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        with_token(ServerSettings(tmp_path), token_file(tmp_path, content, mode))


def test_browsers_stay_signed_in_on_this_computer_and_with_the_same_token(tmp_path: Path) -> None:
    here = ServerSettings(tmp_path)
    given, other = token_file(tmp_path, LONG), tmp_path / "other"
    kept = [with_token(here).cookie, with_token(here).cookie]
    assert kept[0] == kept[1]
    there = [with_token(ServerSettings(tmp_path, host="192.168.0.9")) for _ in range(2)]
    assert there[0].cookie != there[1].cookie
    same = {with_token(settings, given).cookie for settings in (here, *there)}
    assert len(same) == 1
    assert len({*kept, *same, with_token(ServerSettings(other)).cookie}) == 3
    assert with_token(here, token_file(tmp_path, LONG + "2")).cookie not in same
    secret = state_folder() / "secret"
    assert (secret.stat().st_mode & 0o777, secret.parent.stat().st_mode & 0o777) == (0o600, 0o700)
    secret.write_bytes(b"damaged")
    assert with_token(here).cookie != kept[0]


def test_other_users_can_read_neither_projects_nor_jobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(WORK, "propose", "no.such.module:work")
    before = os.umask(0o022)
    try:
        with create_project(tmp_path / "projects", "room", ("person",)) as project:
            project.log.last()
        with running(ServerSettings(tmp_path / "projects", port=0)) as live:
            job = live.client.post("/api/projects/room/jobs", json={"kind": "propose"}).json()
            ended(live, job)
    finally:
        os.umask(before)
    room, jobs = tmp_path / "projects/room", tmp_path / "projects/.jobs"
    assert {folder.stat().st_mode & 0o777 for folder in (room, jobs)} == {0o700}
    files = [*room.glob("project.db*"), *(path for path in jobs.rglob("*") if path.is_file())]
    assert {file.name for file in files} >= {"project.db", "journal.json"}
    assert [file for file in files if file.stat().st_mode & 0o777 != 0o600] == []


PLACES = ((Path("/srv/data/inner"), "inner"), (Path("/srv/data"), "data"), (Path("/home/ada/my takes"), "takes"))


@pytest.mark.parametrize(
    ("message", "shown"),
    [
        ("/srv/data/people/color/1.jpg: missing", "data/people/color/1.jpg: missing"),
        ("/srv/data/inner/x.txt:3: a word", "inner/x.txt:3: a word"),
        ("'/srv/data' and (/srv/data), see /srv/data.", "'data' and (data), see data."),
        ("/srv/data-2/x.png: broken", "…/x.png: broken"),
        ("/srv/database/x.png: broken", "…/x.png: broken"),
        ("/home/ada/my takes/a b/x.png: broken", "takes/a b/x.png: broken"),
        ("/home/bob/private/x.png: broken; give 1 m/s", "…/x.png: broken; give 1 m/s"),
        ("x.png: or/and 3 / 4, http://127.0.0.1:8080/a/b", "x.png: or/and 3 / 4, http://127.0.0.1:8080/a/b"),
        ("/secret: no such file", "…/secret: no such file"),
        ("color/1.jpg: missing", "color/1.jpg: missing"),
    ],
)
def test_messages_name_files_without_their_folders(message: str, shown: str) -> None:
    assert hide_paths(message, PLACES) == shown
    assert hide_paths(shown, PLACES) == shown


@pytest.mark.parametrize(
    ("message", "shown"),
    [
        ("no detector yet; run `annotator train room`", "no detector yet"),
        (
            "no boxes; draw some, import them with `annotator import`, or add a recording",
            "no boxes; draw some, or add a recording",
        ),
        ("no labels; run `annotator annotate` first, or choose other states", "no labels; choose other states"),
        ("3 wait: review them (`annotator serve`), or not (they stay)", "3 wait: review them, or not (they stay)"),
        ("no pair within 0.1 s; give a larger --tolerance", "no pair within 0.1 s"),
        ("set --tolerance", "set --tolerance"),
        ("a well-known class, two - or -- three", "a well-known class, two - or -- three"),
    ],
)
def test_messages_to_a_page_name_no_command(message: str, shown: str) -> None:
    assert without_commands(message) == shown


def test_the_error_of_a_broken_frame_names_its_file_only(live: Live, generated: Path, tmp_path: Path) -> None:
    """For a recording in a registered folder, and for one elsewhere on the disk."""
    project = live.context.project("room")
    elsewhere = tmp_path / "elsewhere" / "own take"
    shutil.copytree(generated / "people", elsewhere)
    (added,) = add_recordings(project, [elsewhere], name="mine")
    frame = project.frames.of([added.recording.id])[1]
    (elsewhere / "color" / "000001.jpg").write_bytes(b"")
    answer = live.client.get(f"/api/projects/room/frames/{frame.id}")
    message = answer.json()["error"]["message"]
    assert (answer.status_code, message.partition(":")[0]) == (400, "mine/color/000001.jpg")
    assert str(tmp_path) not in message
    wrong = live.client.post("/api/projects/room/recordings", json={"path": generated.name}).json()
    assert wrong["error"]["message"].startswith(f"{generated.name}: no known recording format in this folder")
    assert str(generated.parent) not in wrong["error"]["message"]


EXAMPLES = 3
PATIENT = settings(
    max_examples=EXAMPLES,
    phases=[Phase.generate],
    suppress_health_check=list(HealthCheck),
)
# Random ids rarely exist; every second request uses existing ones.
REAL = {"project": "room", "name": "room", "frame": 1, "frame_id": 1, "model": 1, "number": 0}


@pytest.fixture
def fuzzed(tmp_path: Path, generated: Path) -> ServerSettings:
    """A server with a labelled project, which the requests may change."""
    upright = ProjectSettings(rotation=BoxRotation.UPRIGHT)
    with create_project(tmp_path / "projects", "room", ("person",), settings=upright) as project:
        import_own_labels(project, register_recording(project, open_recording(generated / "people")).id)
    return ServerSettings(tmp_path / "projects", (generated,), port=0)


def test_no_request_causes_a_server_error(fuzzed: ServerSettings, monkeypatch: pytest.MonkeyPatch) -> None:
    for kind in WORK:
        monkeypatch.setitem(WORK, kind, "no.such.module:work")
    with running(fuzzed) as live:
        schema = schemathesis.openapi.from_dict(live.client.get("/api/openapi.json").json())
        operations = [found.ok() for found in schema.get_all_operations()]
        assert len(operations) > 20
        # last, since the others need the project and its recording
        operations.sort(key=lambda each: each.method.upper() == "DELETE" or each.path.endswith("/rename"))
        answers: dict[int, int] = {}
        faults: list[str] = []
        numbers = count()

        def ask(case: schemathesis.Case) -> None:
            if next(numbers) % 2:
                case.path_parameters.update({name: REAL[name] for name in case.path_parameters if name in REAL})
            headers = {"Origin": live.url, "Cookie": live.cookies()}
            case.headers.clear()
            case.cookies.clear()
            answer = case.call(base_url=live.url, headers=headers, timeout=300)
            answers[answer.status_code] = answers.get(answer.status_code, 0) + 1
            if answer.status_code >= 500:
                faults.append(f"{answer.status_code}: {case.as_curl_command()}")
            elif answer.status_code >= 400:
                assert set(answer.json()["error"]) == {"kind", "message"}, answer.text

        for operation in operations:
            PATIENT(given(case=operation.as_strategy())(ask))()
        assert live.client.get("/api/projects").status_code == 200, "the server still answers"
    assert not faults, "\n".join(faults[:20])
    assert answers.get(200, 0) > 20, answers
