"""Hours of work on one server, shortened: its memory, refused saves, and how long a save takes.

python -m benchmarks.soak [--minutes 30] [--operators 10] [--browsers 2] [--jobs train,export] [--json]

Operators save on shared frames, browsers leaf through them, and jobs follow each other. Memory is the server's own,
without the processes of its jobs, which end with them. The browsers have no 3D view, since Chromium would render it on
the processor that the server needs.
"""

from __future__ import annotations

import json
import random
import statistics
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from annotator.cli.main import main as annotator
from annotator.project import open_project
from annotator.synthetic import write_generated
from annotator.types.errors import ConfigError
from benchmarks.report import Options, Table, chosen, guarded, program
from benchmarks.served import (
    LABEL,
    OPENS_WITHIN_S,
    PRESET,
    Server,
    answered,
    chromium,
    frames_of,
    percentile,
    serving,
    signed_in,
    until,
)

if TYPE_CHECKING:
    from playwright.sync_api import Page

PROJECT = "soak"
PATH = f"/api/projects/{PROJECT}"
JOBS: dict[str, dict[str, Any]] = {
    "train": {"kind": "train", "roles": ["image"], "image_pictures": 200, "image_size_px": 160},
    "export": {"kind": "export", "format": "kitti"},
    "import": {"kind": "import", "recordings": [1]},
}
# Time that an operator thinks before each save, seconds.
THINKS_S = (0.5, 1.5)
SAMPLED_EVERY_S = 2.0
# Growth is counted from here on, at most from a sixth of the time, so that caches are full; medians over this share of
# the time at both ends.
WARM_AFTER_S, WARM_SHARE, ENDS_SHARE = 300.0, 1 / 6, 1 / 10
MOST_LABELS = 12


@dataclass
class Arguments(Options):
    minutes: float = 30.0
    """Duration, minutes."""
    operators: int = 10
    """Number of clients that save."""
    browsers: int = 2
    """Number of Chromium pages that leaf through the frames."""
    jobs: str = "train,export"
    """Kinds of jobs that are kept in the queue, separated by commas: train, export, import."""
    frames: int = 24
    """Number of frames of the generated 640 x 480 recording."""
    seed: int = 0
    """Seed of the operators' choices."""


@dataclass
class Seen:
    """What all clients saw."""

    saves_s: list[float] = field(default_factory=list)
    # saves that were refused because another operator had saved, and other refusals, as status and text
    stale: int = 0
    refused: list[str] = field(default_factory=list)
    # connections that ended without an answer
    dropped: int = 0
    # received by the operators' sockets, by type
    events: Counter[str] = field(default_factory=Counter)
    # ended, by kind and state
    jobs: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)
    lock: threading.Lock = field(default_factory=threading.Lock)


def run(args: Arguments) -> dict[str, Any]:
    kinds = chosen("--jobs", args.jobs, JOBS)
    with TemporaryDirectory() as temporary, ExitStack() as stack:
        projects = _make_project(Path(temporary), args.frames)
        frames = frames_of(projects, PROJECT)
        server = stack.enter_context(serving(projects))
        browser = stack.enter_context(chromium()) if args.browsers else None
        pages = [_Leafing(signed_in(browser, server, f"browser {n}"), frames) for n in range(args.browsers) if browser]
        memory, seen = _work(server, pages, frames, kinds, args)
        with open_project(projects / PROJECT) as project:
            seen.failures += project.problems()
    return {**_figures(memory, seen, args), "memory": [[round(at), round(mb, 1)] for at, mb in memory]}


def _make_project(folder: Path, frames: int) -> Path:
    """A projects folder with a labelled project, from whose 2D boxes detectors can be trained."""
    recording, projects = folder / PRESET, folder / "projects"
    write_generated(recording, PRESET, frames, 0, 640, 480)
    for words in (
        ["new", PROJECT, "--classes", LABEL],
        ["add", PROJECT, str(recording)],
        ["import", PROJECT, "--as", "2d"],
    ):
        if annotator([*words, "--projects", str(projects)]) != 0:
            raise ConfigError(f"annotator {' '.join(words)} failed")
    return projects


class _Leafing:
    """A page in Review that goes to the next frame every other second, and back at the end."""

    def __init__(self, page: Page, frames: Sequence[int]) -> None:
        self._page, self._frames = page, len(frames)
        self.errors: list[str] = []
        self.shown = 0
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        # without the 3D view
        page.route("**/api/workbench", lambda route: route.abort())
        page.goto(f"/#/{PROJECT}/annotate/{frames[0]}")
        until(page, "document.querySelector('img.picture')?.complete", OPENS_WITHIN_S)

    def leaf(self) -> None:
        self._page.keyboard.press("n" if self.shown // (self._frames - 1) % 2 == 0 else "p")
        self.shown += 1
        self._page.wait_for_timeout(100)


def _work(
    server: Server, pages: Sequence[_Leafing], frames: Sequence[int], kinds: Sequence[str], args: Arguments
) -> tuple[list[tuple[float, float]], Seen]:
    """Lets everyone work; returns the server's memory over time (seconds, MB), and what the clients saw."""
    seen, stop = Seen(), threading.Event()
    works: list[Callable[[], None]] = [
        lambda n=n: _operate(server, n, frames, seen, stop, random.Random(f"{args.seed} {n}"))  # type: ignore[misc]
        for n in range(args.operators)
    ]
    works += [lambda kind=kind: _keep_job(server, kind, seen, stop) for kind in kinds]  # type: ignore[misc]
    threads = [threading.Thread(target=_guarded, args=(work, seen, stop)) for work in works]
    memory: list[tuple[float, float]] = []
    began = time.monotonic()
    for thread in threads:
        thread.start()
    try:
        while (now := time.monotonic() - began) < args.minutes * 60:
            memory.append((now, server.memory_mb()))
            for page in pages:
                page.leaf()
            # the browser's own events are processed within `leaf`
            time.sleep(max(0.0, SAMPLED_EVERY_S - (time.monotonic() - began - now)))
    finally:
        stop.set()
        for thread in threads:
            thread.join()
    for page in pages:
        seen.failures += page.errors
    return memory, seen


def _guarded(work: Callable[[], None], seen: Seen, stop: threading.Event) -> None:
    try:
        work()
    except (httpx.HTTPError, ConfigError, ConnectionClosed, TimeoutError) as error:
        if not stop.is_set():
            with seen.lock:
                seen.failures.append(f"{type(error).__name__}: {error}")


def _operate(
    server: Server, number: int, frames: Sequence[int], seen: Seen, stop: threading.Event, chance: random.Random
) -> None:
    """An operator: visits frames, and listens to events."""
    with server.client(f"operator {number}") as client:
        listening = threading.Thread(target=_guarded, args=(lambda: _listen(server, client, seen, stop), seen, stop))
        listening.start()
        while not stop.is_set():
            try:
                _visit(client, f"{PATH}/frames/{chance.choice(frames)}", seen, stop, chance)
            except httpx.TransportError:
                # a page would read the frame again
                with seen.lock:
                    seen.dropped += 1
        listening.join()


def _visit(client: httpx.Client, path: str, seen: Seen, stop: threading.Event, chance: random.Random) -> None:
    """Opens a frame, saves some changes on it, and now and then undoes one."""
    state = answered(client.get(path))
    client.get(f"{path}/image.jpg")
    for _ in range(chance.randint(1, 8)):
        if stop.wait(chance.uniform(*THINKS_S)):
            return
        state = _save(client, path, state, seen, chance)
    if chance.random() < 0.2:
        # 409: someone else has changed the box since, or nothing is left to undo
        client.post(f"{PATH}/undo", json={})


def _save(client: httpx.Client, path: str, state: dict[str, Any], seen: Seen, chance: random.Random) -> dict[str, Any]:
    """Saves a change like the page; returns the frame's newest state."""
    revision = state["frame"]["revision"]
    body = {"revision": revision, "changes": [_change(state, chance)], "effort": {"actions": 1, "seconds": 1.0}}
    began = time.perf_counter()
    response = client.post(f"{path}/changes", json=body)
    seconds = time.perf_counter() - began
    answer = response.json()
    with seen.lock:
        if response.status_code == 200:
            seen.saves_s.append(seconds)
            return dict(answer)
        # other refusals with 409, such as that of a replaced project, have no state
        if response.status_code == 409 and "state" in answer and answer["state"]["frame"]["revision"] > revision:
            seen.stale += 1
            return dict(answer["state"])
        seen.refused.append(f"{response.status_code} {response.text[:200]}")
    return dict(answered(client.get(path)))


def _change(state: dict[str, Any], chance: random.Random) -> dict[str, Any]:
    labels = [label["uid"] for label in state["labels"]]
    x_m = round(chance.uniform(-2, 2), 6)
    box = {"center": [x_m, 0.0, 3.0], "size": [0.5, 0.6, 1.7], "rotation": np.eye(3).tolist()}
    kind = chance.choice(["create", "edit", "edit", "accept", "reject", "delete"])
    if len(labels) >= MOST_LABELS:
        kind = "delete"
    if not labels or kind == "create":
        return {"kind": "create", "label": LABEL, "box": box}
    change = {"kind": kind, "uid": chance.choice(labels)}
    if kind == "edit":
        change |= {"label": LABEL, "box": box, "track_id": None}
    return change


def _listen(server: Server, client: httpx.Client, seen: Seen, stop: threading.Event) -> None:
    """Receives the events that the operator's page would receive."""
    url = server.url.replace("http", "ws", 1) + f"/api/events?project={PROJECT}"
    cookies = "; ".join(f"{name}={value}" for name, value in client.cookies.items())
    given: dict[str, Any] = {"additional_headers": {"Cookie": cookies}, "origin": server.url}
    with connect(url, **given, open_timeout=OPENS_WITHIN_S, ping_timeout=None) as socket:
        while not stop.is_set():
            try:
                event = json.loads(socket.recv(timeout=1.0))
            except TimeoutError:
                continue
            except ConnectionClosed as error:
                with seen.lock:
                    seen.failures.append(f"an event socket was closed: {error}")
                return
            with seen.lock:
                seen.events[event["type"]] += 1


def _keep_job(server: Server, kind: str, seen: Seen, stop: threading.Event) -> None:
    """Starts a job whenever the last one has ended."""
    with server.client(f"jobs {kind}") as client:
        while not stop.is_set():
            job = answered(client.post(f"{PATH}/jobs", json=JOBS[kind]))
            while job["state"] in ("queued", "running"):
                if stop.wait(1.0):
                    client.post(f"/api/jobs/{job['id']}/cancel")
                    return
                job = next(each for each in answered(client.get("/api/jobs")) if each["id"] == job["id"])
            with seen.lock:
                seen.jobs[f"{kind} {job['state']}"] += 1
                if job["state"] != "done":
                    seen.failures.append(f"job {kind}: {job.get('message')}")


def _figures(memory: Sequence[tuple[float, float]], seen: Seen, args: Arguments) -> dict[str, Any]:
    """The figures; `memory_growth` is relative to the memory after the warm-up."""
    seconds = args.minutes * 60
    warm, width = min(WARM_AFTER_S, WARM_SHARE * seconds), ENDS_SHARE * seconds
    first = [mb for at, mb in memory if warm <= at < warm + width]
    last = [mb for at, mb in memory if at >= seconds - width]
    before, after = (statistics.median(part) if part else float("nan") for part in (first, last))
    return {
        "minutes": args.minutes,
        "saves": len(seen.saves_s),
        "stale": seen.stale,
        "refused_not_stale": len(seen.refused),
        "dropped_connections": seen.dropped,
        "save_p50_s": percentile(seen.saves_s, 50),
        "save_p95_s": percentile(seen.saves_s, 95),
        "save_max_s": max(seen.saves_s, default=float("nan")),
        "memory_start_mb": memory[0][1] if memory else float("nan"),
        "memory_warm_mb": before,
        "memory_end_mb": after,
        "memory_growth": after / before - 1,
        "events": dict(seen.events),
        "jobs": dict(seen.jobs),
        "failures": [*seen.refused[:10], *seen.failures[:10]],
    }


def tables(_: Arguments, result: dict[str, Any]) -> list[Table]:
    return [Table.of_figures({name: value for name, value in result.items() if name != "memory"})]


main = program(Arguments, run, tables, __doc__)


if __name__ == "__main__":
    guarded(main)
