"""Sockets with malformed or endless messages, or held open; writes at once that race each other."""

from __future__ import annotations

import json
import socket
import struct
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
import pytest
from attacks import unharmed
from live_server import PATIENCE_S, Live, running, wait_until
from room_api import BOX, ROOM, change, state
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


RACERS = 10
ROUNDS = 15


def _racing(live: Live, race: Callable[[httpx.Client, int], None]) -> None:
    """Lets `race(client, number)` run for all racers at once, each signed in with its own name."""
    barrier = threading.Barrier(RACERS)
    failures: list[BaseException] = []
    headers, cookies = {"Origin": live.url}, dict(live.client.cookies)

    def run(number: int) -> None:
        try:
            with httpx.Client(base_url=live.url, headers=headers, cookies=cookies, timeout=PATIENCE_S) as client:
                client.cookies.delete("annotator_operator")
                assert client.post("/api/session", json={"operator": f"racer {number}"}).status_code == 200
                barrier.wait(PATIENCE_S)
                race(client, number)
        except BaseException as error:
            failures.append(error)
            barrier.abort()

    threads = [threading.Thread(target=run, args=(number,)) for number in range(RACERS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failures:
        raise failures[0]


def test_of_ten_changes_of_one_box_on_one_revision_one_is_stored(live: Live) -> None:
    made = change(live.client, 0, {"kind": "create", "label": "person", "box": BOX, "track_id": 1}).json()
    (uid,) = (label["uid"] for label in made["labels"])
    lock, barrier = threading.Lock(), threading.Barrier(RACERS)
    won: Counter[int] = Counter()
    answers: list[int] = []

    def race(client: httpx.Client, number: int) -> None:
        for round_ in range(ROUNDS):
            revision = state(client)["frame"]["revision"]
            barrier.wait(PATIENCE_S)
            box = {**BOX, "center": [number / 10, round_ / 100, 3.0]}
            edit = {"kind": "edit", "uid": uid, "label": "person", "box": box, "track_id": number}
            answer = change(client, revision, edit)
            with lock:
                answers.append(answer.status_code)
                if answer.status_code == 200:
                    won[round_] += 1
                    mine = answer.json()["labels"][0]
                    assert (mine["track_id"], mine["box"]["center"]) == (number, box["center"])
            barrier.wait(PATIENCE_S)

    _racing(live, race)
    assert Counter(answers) == {200: ROUNDS, 409: ROUNDS * (RACERS - 1)}
    assert set(won.values()) == {1}
    assert state(live.client)["frame"]["revision"] == made["frame"]["revision"] + ROUNDS


def test_undo_during_a_race_reverts_own_work_only(live: Live) -> None:
    lock = threading.Lock()
    kept: set[str] = set()

    def race(client: httpx.Client, number: int) -> None:
        mine: list[str] = []
        for _ in range(6):
            while True:
                before = state(client)
                answer = change(client, before["frame"]["revision"], {"kind": "create", "label": "person", "box": BOX})
                if answer.status_code == 200:
                    break
                assert answer.status_code == 409
            old = {label["uid"] for label in before["labels"]}
            mine += [label["uid"] for label in answer.json()["labels"] if label["uid"] not in old]
        for _ in range(3):
            assert client.post(f"{ROOM}/undo", json={}).status_code == 200
        with lock:
            kept.update(mine[:3])

    _racing(live, race)
    assert {label["uid"] for label in state(live.client)["labels"]} == kept
    assert len(kept) == 3 * RACERS


def test_classes_and_recordings_that_ten_change_at_once_stay_whole(live: Live) -> None:
    def race(client: httpx.Client, number: int) -> None:
        for _ in range(5):
            names = ["person", f"class{number}"]
            added = client.post(f"{ROOM}/recordings", json={"path": "once_generated/hands", "labels": False})
            assert added.status_code == 200 or "is in the project already" in added.text
            answers: list[Any] = [client.patch(ROOM, json={"classes": names}), client.get(ROOM)]
            assert all(answer.status_code == 200 for answer in answers), [answer.text for answer in answers]
            assert len(answers[1].json()["classes"]) == 2

    _racing(live, race)
    found = live.client.get(ROOM).json()
    assert [recording["name"] for recording in found["recordings"]] == ["people", "hands"]
    assert live.context.project("room").frames.count_present() == 10
