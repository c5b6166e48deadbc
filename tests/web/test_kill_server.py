"""`kill -9` of the server during a scripted editing run: every acknowledged edit is stored."""

from __future__ import annotations

import random
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
from live_server import PATIENCE_S, wait_until

from annotator.project import Project, open_project
from annotator.web.security import ServerSettings

# The minimum number of edits before each kill.
EDITS_BEFORE_KILL = 5
LOG_CHARACTERS = 6000
BOX = {"center": [0.1, 0.2, 3.0], "size": [0.8, 0.5, 1.7], "quaternion": [1.0, 0.0, 0.0, 0.0]}


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
