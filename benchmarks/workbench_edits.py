"""Checks that no saved edit is lost: when the server is killed with `kill -9`, and with many operators on one frame."""

from __future__ import annotations

import json
import random
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from annotator.types.errors import ConfigError
from benchmarks.workbench_browser import open_mode, signed_in
from benchmarks.workbench_server import LABEL, Server, answered, percentile

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

SIZE_M = [0.5, 0.6, 1.7]
IDENTITY = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
# Minimum and maximum time of editing before the server is killed, seconds.
LIVES_S = (0.3, 2.5)
# Time limit for all clients to connect, seconds.
READY_WITHIN_S = 90.0

Stored = dict[str, tuple[str, float]]
"""Labels by uid: state, and x of the centre, which is different for each edit."""


def kill(projects: Path, name: str, frame: int, times: int, seed: int = 0) -> dict[str, Any]:
    """Edits a frame, kills the server meanwhile, and checks the stored labels; repeated `times` times."""
    chance = random.Random(seed)
    acknowledged = lost = 0
    for _ in range(times):
        server = Server(projects)
        timer = threading.Timer(chance.uniform(*LIVES_S), server.kill)
        with server.client() as client:
            script = _Script(client, name, frame, chance)
            # started after the frame is loaded, so that the time is spent on edits
            timer.start()
            script.run()
        timer.join()
        acknowledged += script.acknowledged
        lost += not script.accounts_for(_stored(projects, name, frame))
    return {"kills": times, "edits_acknowledged": acknowledged, "kills_that_lost_an_edit": lost}


class _Script:
    """Creates, moves, accepts and deletes boxes until the server is killed.

    Attributes:
        known: labels after the last acknowledged edit.
        expected: labels after the pending edit, which may be stored before it is acknowledged.
        acknowledged: number of acknowledged edits.
    """

    def __init__(self, client: httpx.Client, name: str, frame: int, chance: random.Random) -> None:
        self._client, self._chance = client, chance
        self._path = f"/api/projects/{name}/frames/{frame}"
        self.acknowledged = 0
        state = answered(client.get(self._path))
        self._revision: int = state["frame"]["revision"]
        self.known = self.expected = _labels(state)

    def run(self) -> None:
        while True:
            change, self.expected = self._next()
            body = {"revision": self._revision, "changes": [change]}
            try:
                response = self._client.post(f"{self._path}/changes", json=body)
            except httpx.TransportError:
                return
            state = answered(response)
            if change["kind"] == "create":
                # the server assigns the uid of a new box
                (uid,) = _labels(state).keys() - self.known.keys()
                self.expected = {**self.known, uid: self.expected["?"]}
            if _labels(state) != self.expected:
                raise ConfigError(f"the response to a change of kind {change['kind']} does not contain the change")
            self.known, self._revision = self.expected, state["frame"]["revision"]
            self.acknowledged += 1

    def accounts_for(self, stored: Stored) -> bool:
        """Whether all acknowledged edits are stored, and at most the pending edit in addition."""
        new = stored.keys() - self.known.keys()
        if "?" in self.expected and len(new) == 1:
            return stored == {**self.known, new.pop(): self.expected["?"]}
        return stored in (self.known, self.expected)

    def _next(self) -> tuple[dict[str, Any], Stored]:
        uid = self._chance.choice(sorted(self.known)) if self.known else None
        kind = self._chance.choice(["create", "edit", "edit", "accept", "reject", "delete"])
        if uid is None or (kind == "delete" and len(self.known) < 4) or (kind == "create" and len(self.known) > 12):
            kind = "create" if uid is None else "edit"
        x = round(self._chance.uniform(-2, 2), 6)
        rest = {other: label for other, label in self.known.items() if other != uid}
        if kind == "create":
            return {"kind": "create", "label": LABEL, "box": box_at(x)}, {**self.known, "?": ("accepted", x)}
        assert uid is not None
        if kind == "edit":
            change = {"kind": "edit", "uid": uid, "label": LABEL, "box": box_at(x), "track_id": None}
            return change, {**rest, uid: ("edited", x)}
        if kind == "delete":
            return {"kind": "delete", "uid": uid}, rest
        state = "accepted" if kind == "accept" else "rejected"
        return {"kind": kind, "uid": uid}, {**rest, uid: (state, self.known[uid][1])}


def box_at(x_m: float) -> dict[str, Any]:
    """A box in front of the camera."""
    return {"center": [x_m, 0.0, 3.0], "size": SIZE_M, "rotation": IDENTITY}


def _labels(state: dict[str, Any]) -> Stored:
    return {label["uid"]: (label["state"], round(label["box"]["center"][0], 6)) for label in state["labels"]}


def _stored(projects: Path, name: str, frame: int) -> Stored:
    from annotator.project import open_project

    with open_project(projects / name) as project:
        if problems := project.problems():
            raise ConfigError(f"the database is damaged: {problems[0]}")
        labels = project.labels.of_frame(frame)
    return {label.uid: (label.state.value, round(float(label.box.center_m[0]), 6)) for label in labels}


@dataclass
class _Listener:
    """A client's event socket, and the time at which each revision was announced."""

    announced_s: dict[int, float] = field(default_factory=dict)

    def listen(self, server: Server, cookies: str, project: str, frame: int, ready: threading.Barrier) -> None:
        url = server.url.replace("http", "ws", 1) + f"/api/events?project={project}"
        with connect(url, additional_headers={"Cookie": cookies}, origin=server.url) as socket:  # type: ignore[arg-type]
            socket.send(f'{{"type": "open", "project": "{project}", "frame": {frame}}}')
            ready.wait(READY_WITHIN_S)
            try:
                while True:
                    event = json.loads(socket.recv(timeout=5))
                    if event["type"] == "frame" and event["frame"] == frame:
                        self.announced_s.setdefault(event["revision"], time.time())
            except (TimeoutError, ConnectionClosed):
                return


def clients(
    browser: Browser | None, server: Server, project: str, frame: int, number: int, edits: int
) -> dict[str, Any]:
    """Lets several clients add boxes to one frame at once while two browsers show it; counts lost and late edits.

    If an edit is refused for a stale revision, the client sends it again with the current revision, after a short
    delay like that of a person.
    """
    path = f"/api/projects/{project}/frames/{frame}"
    with server.client() as client:
        before = _labels(answered(client.get(path)))
    pages = [] if browser is None else [signed_in(browser, server, name) for name in ("Grace", "Edsger")]
    for page in pages:
        open_mode(page, project, "review", frame)
        page.evaluate(COUNT_ROWS)
    listeners = [_Listener() for _ in range(number)]
    saved: dict[int, float] = {}
    created: dict[str, float] = {}
    refused: list[int] = []
    lock = threading.Lock()
    ready = threading.Barrier(2 * number)

    def edit(n: int) -> None:
        chance = random.Random(n)
        with server.client(f"operator {n}") as client:
            cookies = "; ".join(f"{name}={value}" for name, value in client.cookies.items())
            listening = pool.submit(listeners[n].listen, server, cookies, project, frame, ready)
            revision = answered(client.get(path))["frame"]["revision"]
            ready.wait(READY_WITHIN_S)
            for turn in range(edits):
                x = round(-2 + 4 * (n * edits + turn) / (number * edits), 6)
                body = {"changes": [{"kind": "create", "label": LABEL, "box": box_at(x)}]}
                while True:
                    response = client.post(f"{path}/changes", json={"revision": revision, **body})
                    answer = response.json()
                    if response.status_code != 409:
                        break
                    revision = answer["state"]["frame"]["revision"]
                    with lock:
                        refused.append(n)
                    time.sleep(chance.uniform(0.05, 0.4))
                now = time.time()
                state = answered(response)
                revision = state["frame"]["revision"]
                new_uids = [uid for uid, (_, at) in _labels(state).items() if at == x]
                with lock:
                    saved[revision] = now
                    created.update(dict.fromkeys(new_uids, x))
                time.sleep(chance.uniform(0.2, 1.0))
            listening.result()

    with ThreadPoolExecutor(2 * number) as pool:
        for future in [pool.submit(edit, n) for n in range(number)]:
            _pump(future, pages)
    with server.client() as client:
        after = _labels(answered(client.get(path)))
    late = [
        announced[r] - at
        for announced in (entry.announced_s for entry in listeners)
        for r, at in saved.items()
        if r in announced
    ]
    missed = sum(r not in entry.announced_s for entry in listeners for r in saved)
    shown = [_display_delays(page, len(before), saved) for page in pages]
    for page in pages:
        page.context.close()
    return {
        "clients": number,
        "edits": number * edits,
        "refused_as_stale": len(refused),
        "lost": sum(after.get(uid, ("", None))[1] != x for uid, x in created.items()) + number * edits - len(created),
        "crossed": len(after) - len(before) - number * edits,
        "events_missed": missed,
        "event_p95_s": percentile(late, 95),
        "event_max_s": max(late, default=float("nan")),
        "browsers": len(pages),
        "browsers_all_shown": all(entry["shown"] == len(after) for entry in shown),
        "browser_p95_s": percentile([late for entry in shown for late in entry["late_s"]], 95),
        "browser_max_s": max((late for entry in shown for late in entry["late_s"]), default=float("nan")),
    }


# Records in `window.rows` how many boxes the page lists, and since when.
COUNT_ROWS = """() => {
  window.rows = [];
  setInterval(() => {
    const count = document.querySelectorAll("[data-testid=frame-box]").length;
    if (count !== (window.rows.at(-1)?.[0] ?? -1)) window.rows.push([count, Date.now() / 1000]);
  }, 10);
}"""


def _pump(future: Any, pages: list[Page]) -> None:
    """Waits for a client; meanwhile the browser's events are processed."""
    while not future.done():
        if pages:
            pages[0].wait_for_timeout(100)
        else:
            time.sleep(0.05)
    future.result()


def _display_delays(page: Page, before: int, saved: dict[int, float]) -> dict[str, Any]:
    """Delay from each save until the page lists the new number of boxes, seconds."""
    page.wait_for_timeout(1500)
    rows: list[list[float]] = page.evaluate("window.rows")
    late = []
    for number, revision in enumerate(sorted(saved), start=1):
        since = [at for count, at in rows if count >= before + number]
        late.append(min(since) - saved[revision] if since else float("inf"))
    return {"shown": int(rows[-1][0]), "late_s": late}
