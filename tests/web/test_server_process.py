"""The process of a server: memory, what is loaded ahead, one server a projects folder, a kill while it edits;
connections that send slowly, too many of them, and a log that stays small.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import random
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
import pytest
from live_server import PATIENCE_S, running, wait_until
from room_api import BOX

from annotator.project import Project, create_project, open_project
from annotator.types.errors import ConfigError
from annotator.web import limits
from annotator.web.folders import hold_server_lock
from annotator.web.limits import FILE, MOST_KEYS, Connections, Rate, address_key, limited_log
from annotator.web.security import ServerSettings

if TYPE_CHECKING:
    from live_server import Live


def test_a_second_server_is_refused_while_the_first_one_runs(tmp_path: Path) -> None:
    with hold_server_lock(tmp_path / "projects"):
        with (
            pytest.raises(ConfigError, match=r"projects: another `annotator serve` uses these projects"),
            hold_server_lock(tmp_path / "projects"),
        ):
            pass
        with hold_server_lock(tmp_path / "others"):
            pass
    with hold_server_lock(tmp_path / "projects"):
        pass


def test_a_file_system_without_locks_causes_only_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(file: object, how: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", refuse)
    with hold_server_lock(tmp_path / "projects"):
        assert "does not support locks (No locks available)" in caplog.text


def test_a_folder_that_cannot_be_written_is_reported(tmp_path: Path) -> None:
    (tmp_path / "projects").write_text("a file")
    with (
        pytest.raises(ConfigError, match="choose another folder with --projects"),
        hold_server_lock(tmp_path / "projects"),
    ):
        pass


# The minimum number of edits before each kill.
EDITS_BEFORE_KILL = 5
LOG_CHARACTERS = 6000


@contextmanager
def server(projects: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    words = ["--projects", str(projects), "--port", str(port), "--no-token"]
    command = [sys.executable, "-m", "annotator", "serve", *words]
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=log)
        url = f"http://127.0.0.1:{port}"
        try:
            _wait_until_it_answers(url, process)
            yield url, process
        finally:
            process.kill()
            process.wait()
            log.seek(0)
            # pytest shows it if the test fails
            sys.stdout.write(log.read().decode(errors="replace")[-LOG_CHARACTERS:])


def _wait_until_it_answers(url: str, process: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + PATIENCE_S
    while True:
        assert process.poll() is None, "the server did not start"
        try:
            httpx.get(f"{url}/api/session", timeout=30)
            return
        except httpx.TransportError:
            assert time.monotonic() < end, "the server does not answer"
            time.sleep(0.1)


class Editor:
    """Edits one frame as fast as possible, and records the acknowledged state."""

    def __init__(self, url: str, frame: int, seed: int, operator: str = "ann") -> None:
        self.url, self.frame, self.operator = url, frame, operator
        self.chance = random.Random(seed)
        self.revision = 0
        self.labels: dict[str, tuple[str, int | None]] = {}
        self.acknowledged = 0

    def run(self) -> None:
        try:
            with httpx.Client(base_url=self.url, headers={"Origin": self.url}, timeout=PATIENCE_S) as client:
                client.post("/api/session", json={"operator": self.operator})
                self._take(client.get(f"/api/projects/room/frames/{self.frame}").json())
                while True:
                    self._edit(client)
        except httpx.TransportError:
            return  # the server is dead

    def _edit(self, client: httpx.Client) -> None:
        what = self.chance.choice(["create", "create", "edit", "reject", "delete", "undo"])
        if what == "undo":
            answer = client.post("/api/projects/room/undo", json={})
            if answer.status_code == 200:
                self._take(answer.json()["state"])
            return
        change: dict[str, Any] = {"kind": "create", "label": "person", "box": BOX, "track_id": self.revision}
        if what != "create" and self.labels:
            uid = self.chance.choice(sorted(self.labels))
            change = {"kind": what, "uid": uid}
            if what == "edit":
                change |= {"label": "person", "box": BOX, "track_id": 1000 + self.revision}
        body = {"revision": self.revision, "changes": [change], "effort": {"actions": 1, "seconds": 0.1}}
        answer = client.post(f"/api/projects/room/frames/{self.frame}/changes", json=body)
        assert answer.status_code == 200, answer.text
        self._take(answer.json())

    def require_kept(self, project: Project) -> None:
        """The state of the last acknowledged answer is stored; one more edit may be stored without an answer."""
        log, last = project.log.of_frame(self.frame), project.frames.get(self.frame).revision
        assert self.revision <= last == len(log)
        if last == self.revision:
            labels = project.labels.of_frame(self.frame)
            assert {label.uid: (label.state.value, label.track_id) for label in labels} == self.labels

    def _take(self, state: dict[str, Any]) -> None:
        self.revision = state["frame"]["revision"]
        self.labels = {label["uid"]: (label["state"], label["track_id"]) for label in state["labels"]}
        self.acknowledged += 1


def test_every_acknowledged_edit_survives_a_kill(web_settings: ServerSettings) -> None:
    with server(web_settings.projects_root) as (url, process):
        editor = Editor(url, 1, 0)
        thread = threading.Thread(target=editor.run)
        thread.start()
        wait_until(lambda: editor.acknowledged > EDITS_BEFORE_KILL)
        process.send_signal(signal.SIGKILL)
        process.wait()
        thread.join(PATIENCE_S)
    with open_project(web_settings.projects_root / "room") as project:
        assert project.problems() == []
        editor.require_kept(project)
        assert project.log.rebuild() > 0


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
    assert (len(connections._addresses), len(connections._silent)) == (8, 0)
    assert arrive("n")[0].closed, "there is no silent one to turn out"
    for transport in [*known, *more]:
        connections.leave(transport)
    assert not connections._addresses
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
