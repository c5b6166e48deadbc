"""Checks that no saved edit is lost with many operators on one frame."""

from __future__ import annotations

import json
import random
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from benchmarks.workbench_browser import open_mode, signed_in
from benchmarks.workbench_server import LABEL, Server, answered, percentile

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

SIZE_M = [0.5, 0.6, 1.7]
IDENTITY = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
# Time limit for all clients to connect, seconds.
READY_WITHIN_S = 90.0

Stored = dict[str, tuple[str, float]]
"""Labels by uid: state, and x of the centre, which is different for each edit."""


def box_at(x_m: float) -> dict[str, Any]:
    """A box in front of the camera."""
    return {"center": [x_m, 0.0, 3.0], "size": SIZE_M, "rotation": IDENTITY}


def _labels(state: dict[str, Any]) -> Stored:
    return {label["uid"]: (label["state"], round(label["box"]["center"][0], 6)) for label in state["labels"]}


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
