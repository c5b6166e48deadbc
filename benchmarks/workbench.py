"""The workbench's requirements: the operator's waiting times, and that no saved edit is lost.

python -m benchmarks.workbench [--only switch,views,clients] [--json]

The browser is headless Chromium, which renders WebGL in software. On a computer with a graphics card the 3D view is
faster.
"""

from __future__ import annotations

import json
import os
import random
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from annotator.types.errors import ConfigError
from benchmarks.report import Table, finish, guarded
from benchmarks.served import (
    CLOUD_BYTES,
    CLOUD_PROBE,
    LABEL,
    PRESET,
    Server,
    answered,
    chromium,
    draw_box,
    frames_of,
    make_people,
    make_project,
    measured,
    open_mode,
    percentile,
    serving,
    signed_in,
    wait_for_frame,
    watch,
)

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


PARTS = ("switch", "views", "clients")
KITTI = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc")


@dataclass
class Arguments:
    """Measure the workbench on generated recordings and KITTI frames."""

    only: str = ",".join(PARTS)
    """Parts to measure, separated by commas."""
    frames: int = 12
    """Number of frames of the generated 640 x 480 recording."""
    switches: int = 60
    """Number of frame switches on each recording."""
    boxes: int = 24
    """Number of image boxes to draw on each recording."""
    clients: int = 20
    """Number of simultaneous clients on one frame."""
    edits: int = 5
    """Number of edits by each client."""
    shared: Path = Path(os.environ.get("ANNOTATOR_SHARED", "../shared"))
    """Folder with `data/kitti`, KITTI object frames with whole scans; KITTI is skipped if it is missing."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


def run(args: Arguments) -> dict[str, Any]:
    """Runs the benchmark; returns what `--json` prints.

    Raises:
        ConfigError: an unknown part, no browser, or a server that does not start.
    """
    parts = [part.strip() for part in args.only.split(",") if part.strip()]
    if unknown := [part for part in parts if part not in PARTS]:
        raise ConfigError(f"--only: unknown part {unknown[0]!r}; the parts are {', '.join(PARTS)}")
    with TemporaryDirectory() as temporary:
        return {name: measure(args, Path(temporary)) for name, measure in _measures().items() if name in parts}


def _measures() -> dict[str, Callable[[Arguments, Path], dict[str, Any]]]:
    measures = (measure_switch, measure_views, measure_clients)
    return dict(zip(PARTS, measures, strict=True))


def _people(args: Arguments, folder: Path) -> Path:
    """The generated recording, created on first use."""
    path = folder / PRESET
    return path if path.exists() else make_people(path, args.frames, 640, 480)


def measure_switch(args: Arguments, folder: Path) -> dict[str, Any]:
    """Switches between the frames of each recording, with all labels shown."""
    projects = folder / "switch"
    recordings = {"rgbd": _people(args, folder), "kitti": args.shared / "data" / "kitti"}
    available = {name: path for name, path in recordings.items() if path.is_dir()}
    for name, path in available.items():
        make_project(projects, name, (LABEL,) if name == "rgbd" else KITTI, [path])
    with serving(projects) as server, chromium() as browser:
        return {name: switch(browser, server, name, frames_of(projects, name), args.switches) for name in available}


def measure_views(args: Arguments, folder: Path) -> dict[str, Any]:
    """Draws image boxes around true objects, on unlabelled frames."""
    projects, recording = folder / "views", _people(args, folder)
    make_project(projects, "views", (LABEL,), [recording])
    boxes = _true_boxes(projects, "views", recording)
    with serving(projects) as server, chromium() as browser:
        return views(browser, server, "views", boxes[: args.boxes])


def _true_boxes(projects: Path, name: str, path: Path) -> list[tuple[int, tuple[float, float, float, float]]]:
    """The frame's id and the edges on the image of each visible object of a project's recording."""
    from annotator.geometry.outline import box_on_image
    from annotator.recordings import open_recording
    from annotator.workflows.recorded.reading import load_truth

    recording = open_recording(path)
    boxes = []
    for index, frame_id in enumerate(frames_of(projects, name)):
        frame = recording.frame(index)
        for truth in load_truth(recording, index, frame):
            box = box_on_image(frame.camera, truth.box, truth.label, 20)
            if box is not None:
                boxes.append((frame_id, box.xyxy))
    return boxes


def measure_clients(args: Arguments, folder: Path) -> dict[str, Any]:
    """Lets many operators edit one frame."""
    projects = folder / "clients"
    make_project(projects, "clients", (LABEL,), [_people(args, folder)])
    frame = frames_of(projects, "clients")[0]
    with ExitStack() as stack:
        server = stack.enter_context(serving(projects))
        browser = stack.enter_context(chromium())
        return clients(browser, server, "clients", frame, args.clients, args.edits)


def switch(browser: Browser, server: Server, project: str, frames: Sequence[int], rounds: int) -> dict[str, Any]:
    """Time from the key N or P until the new frame's image and cloud are on screen, in Review."""
    page = signed_in(browser, server)
    open_mode(page, project, "review", frames[0])
    page.evaluate(CLOUD_PROBE, CLOUD_BYTES)
    times: list[dict[str, float]] = []
    keys = ["n"] * (len(frames) - 1) + ["p"] * (len(frames) - 1)
    for number in range(rounds):
        watch(page, "keydown", "[data-testid=image-editor] img.picture, img.picture[src*='image.jpg']", True)
        page.keyboard.press(keys[number % len(keys)])
        times.append(measured(page))
    page.context.close()
    both = [max(t.values()) for t in times if "view" in t]
    images, clouds = [t["picture"] for t in times], [t["view"] for t in times if "view" in t]
    return {
        "switches": len(both),
        "p50_ms": percentile(both, 50),
        "p95_ms": percentile(both, 95),
        "image_p95_ms": percentile(images, 95),
        "cloud_p95_ms": percentile(clouds, 95),
    }


def views(
    browser: Browser, server: Server, project: str, boxes: Sequence[tuple[int, tuple[float, float, float, float]]]
) -> dict[str, Any]:
    """Time from the release of the mouse after drawing an image box until its two pseudo-views are on screen, in Label.

    Args:
        boxes: frame, and x_min, y_min, x_max, y_max on its image, pixels.
    """
    page = signed_in(browser, server)
    open_mode(page, project, "label", boxes[0][0])
    times = []
    for frame, box in boxes:
        page.evaluate("(hash) => (location.hash = hash)", f"#/{project}/label/{frame}")
        wait_for_frame(page, frame)
        watch(page, "pointerup", ".views img.picture", False)
        draw_box(page, box)
        times.append(measured(page)["picture"])
        page.wait_for_timeout(300)
    page.context.close()
    return {"boxes": len(times), "p50_ms": percentile(times, 50), "p95_ms": percentile(times, 95)}


def _rows(result: Mapping[str, Any], prefix: str = "") -> list[tuple[str, object]]:
    rows: list[tuple[str, object]] = []
    for name, value in result.items():
        rows += _rows(value, f"{prefix}{name} ") if isinstance(value, Mapping) else [(f"{prefix}{name}", value)]
    return rows


def main() -> None:
    args = tyro.cli(Arguments, description=__doc__)
    result = run(args)
    table = Table("measure", "figure")
    for row in _rows(result):
        table.add(*row)
    finish(result, args.json, table)


if __name__ == "__main__":
    guarded(main)
