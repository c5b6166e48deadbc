"""The operator's waiting times in the browser, and how many points turn at 20 frames a second.

python -m benchmarks.workbench [--only next_frame,next_proposal,draw_to_box,points,views,timeline] [--json]

- `next_frame`: from the key N or P until the new frame's picture, boxes, list and points are on screen,
- `next_proposal`: from Space on a proposal of the queue, in its usual order, until the next one is on screen: its
  frame's picture, its box and its three views,
- `draw_to_box`: from the release of the mouse until the 3D box is on the image, with detectors that are loaded,
- `points`: how many points are drawn in the median while the mouse turns the 3D view, and frames a second,
- `views`: from the release of the mouse after drawing an image box until its two pseudo-views are on screen,
- `timeline`: a drawing of the timeline.

The browser is headless Chromium, which renders WebGL in software. On a computer with a graphics card the 3D view is
faster. The true objects are proposed, but for `draw_to_box` and `views`.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from annotator.geometry.outline import box_on_image
from annotator.project import WriteContext, create_project
from annotator.recordings import open_recording
from annotator.synthetic import write_generated
from annotator.types import Box2D, Proposal, Quality, Source
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.recorded.reading import load_truth
from benchmarks.report import Options, Table, chosen, guarded, program
from benchmarks.served import (
    CLOUD_BYTES,
    CLOUD_PROBE,
    LABEL,
    PRESET,
    Server,
    chromium,
    draw_box,
    frames_of,
    measured,
    open_frame,
    percentile,
    serving,
    signed_in,
    wait_for_frame,
    watch,
)

if TYPE_CHECKING:
    from playwright.sync_api import Browser

PARTS = ("next_frame", "next_proposal", "draw_to_box", "points", "views", "timeline")
KITTI = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc")
# Points of an object that can be seen.
LEAST_POINTS = 20
# How long the 3D view is turned before the points are counted, and meanwhile, seconds; and the mouse's steps a second.
SETTLES_S, TURNS_S, STEPS = 6.0, 8.0, 50

IMAGE = "[data-testid=image-editor]"
FRAME = f"{IMAGE} img.picture, {IMAGE} .overlay, [data-testid=frame-box]"
PROPOSAL = f"{IMAGE} img.picture, {IMAGE} .tag.selected, [data-testid=orthos]"
NEW_BOX, VIEWS = f"{IMAGE} .overlay[data-id^=new]", ".views img.picture"

DrawnBox = tuple[int, tuple[float, float, float, float]]
"""A frame's id, and x_min, y_min, x_max, y_max on its image, pixels."""


@dataclass
class Arguments(Options):
    only: str = ",".join(PARTS)
    """Parts to measure, separated by commas."""
    frames: int = 12
    """Number of frames of the generated 640 x 480 recording."""
    switches: int = 60
    """Number of frame switches, and of proposals at most, on each recording."""
    boxes: int = 24
    """Number of image boxes to draw, at most, on each recording."""
    shared: Path = Path(os.environ.get("ANNOTATOR_SHARED", "../shared"))
    """Folder with `data/kitti`, KITTI object frames; KITTI is skipped if it is missing."""


def run(args: Arguments) -> dict[str, Any]:
    """Milliseconds by part and recording, as `--json` prints them."""
    parts = chosen("--only", args.only, PARTS)
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        projects, people, kitti = folder / "projects", folder / PRESET, args.shared / "data" / "kitti"
        write_generated(people, PRESET, args.frames, 0, 640, 480)
        recordings = {"rgbd": (people, (LABEL,)), **({"kitti": (kitti, KITTI)} if kitti.is_dir() else {})}
        objects = {name: _add(projects, name, *recordings[name]) for name in recordings}
        result: dict[str, Any] = {part: {} for part in parts}
        with serving(projects) as server, chromium() as browser:
            for part in parts:
                for name in recordings if part not in ("views", "timeline") else ["rgbd"]:
                    frames = frames_of(projects, name)
                    result[part][name] = _figures(args, part, browser, server, name, frames, objects[name])
        return result


def _figures(
    args: Arguments,
    part: str,
    browser: Browser,
    server: Server,
    project: str,
    frames: Sequence[int],
    objects: Sequence[DrawnBox],
) -> dict[str, Any]:
    """The figures of one part and recording."""
    match part:
        case "next_frame":
            return next_frame(browser, server, project, frames, args.switches)
        case "next_proposal":
            return next_proposal(browser, server, project, min(args.switches, len(objects) - 2))
        case "points":
            return points(browser, server, project, frames[0])
        case "timeline":
            return timeline(browser, server, project, frames)
        case _:
            found = NEW_BOX if part == "draw_to_box" else VIEWS
            return drawn(browser, server, f"{project}-bare", objects[: args.boxes], found)


def _add(projects: Path, name: str, path: Path, classes: Sequence[str]) -> list[DrawnBox]:
    """Adds a project in which the true objects of a recording are proposed, and one without boxes.

    Returns:
        The objects on the images.
    """
    recording, quality = open_recording(path), np.random.default_rng(0)
    with create_project(projects, f"{name}-bare", classes) as bare:
        register_recording(bare, recording)
    drawn: list[DrawnBox] = []
    with create_project(projects, name, classes) as project:
        register_recording(project, recording)
        for index, stored in enumerate(project.frames.of()):
            frame, proposals = recording.frame(index), []
            for truth in load_truth(recording, index, frame):
                box = box_on_image(frame.camera, truth.box, truth.label, LEAST_POINTS)
                if box is None or truth.label not in classes:
                    continue
                drawn.append((stored.id, box.xyxy))
                doubt = Quality(*quality.uniform(0.0, 0.5, 3))
                proposals.append(Proposal(truth.label, 0.8, truth.box, Box2D(truth.label, *box.xyxy), (), doubt))
            project.proposals.replace(stored.id, proposals, WriteContext(stored.revision, "rcv", Source.AUTO))
    return drawn


def next_frame(browser: Browser, server: Server, project: str, frames: Sequence[int], rounds: int) -> dict[str, Any]:
    """The part of this name, milliseconds."""
    page = signed_in(browser, server)
    open_frame(page, project, frames[0])
    page.evaluate(CLOUD_PROBE, CLOUD_BYTES)
    times: list[dict[str, float]] = []
    keys = ["n"] * (len(frames) - 1) + ["p"] * (len(frames) - 1)
    for number in range(rounds):
        watch(page, "keydown", FRAME, True)
        page.keyboard.press(keys[number % len(keys)])
        times.append(measured(page))
    page.context.close()
    both = [max(t.values()) for t in times if "view" in t]
    return {
        "rounds": len(both),
        **_percentiles(both),
        "page_p95_ms": percentile([t["page"] for t in times], 95),
        "cloud_p95_ms": percentile([t["view"] for t in times if "view" in t], 95),
    }


def next_proposal(browser: Browser, server: Server, project: str, rounds: int) -> dict[str, Any]:
    """The part of this name, milliseconds."""
    page = signed_in(browser, server)
    # the first of the queue
    open_frame(page, project, None)
    times = []
    for _ in range(rounds):
        watch(page, "keydown", PROPOSAL, False)
        page.keyboard.press("Space")
        times.append(measured(page)["page"])
    page.context.close()
    return {"rounds": len(times), **_percentiles(times)}


def drawn(browser: Browser, server: Server, project: str, boxes: Sequence[DrawnBox], selector: str) -> dict[str, Any]:
    """Time from the release of the mouse after drawing a box until what the selector finds is on screen, milliseconds.

    Args:
        selector: `NEW_BOX`, the 3D box on the image; or `VIEWS`, the pseudo-views to draw on.
    """
    page = signed_in(browser, server)
    open_frame(page, project, boxes[0][0])
    if selector is VIEWS:
        page.keyboard.press("d")
    times = []
    # the first one loads the detectors
    for frame, box in [boxes[0], *boxes]:
        page.evaluate("(hash) => (location.hash = hash)", f"#/{project}/annotate/{frame}")
        wait_for_frame(page, frame)
        watch(page, "pointerup", selector, False)
        draw_box(page, box)
        times.append(measured(page)["page"])
        if selector is NEW_BOX:
            page.keyboard.press("Delete")
        page.wait_for_timeout(300)
    page.context.close()
    return {"rounds": len(times) - 1, **_percentiles(times[1:])}


def _percentiles(times: Sequence[float]) -> dict[str, float]:
    return {"p50_ms": percentile(times, 50), "p95_ms": percentile(times, 95)}


# Keeps the number of points, and the time, of each drawing of a cloud, in the page that draws it.
COUNTS = """() => {
  const gl = WebGL2RenderingContext.prototype;
  const { drawArrays } = gl;
  window.clouds = [];
  gl.drawArrays = function (mode, first, count) {
    // the 3D view keeps a shader by a cloud of two points
    if (mode === this.POINTS && count > 2) window.clouds.push([count, performance.now()]);
    drawArrays.call(this, mode, first, count);
  };
}"""


def points(browser: Browser, server: Server, project: str, frame: int) -> dict[str, Any]:
    """The part of this name."""
    page = signed_in(browser, server)
    page.add_init_script(f"({COUNTS})()")
    open_frame(page, project, frame)
    stage = page.get_by_test_id("viewport").bounding_box()
    assert stage is not None
    x, y = stage["x"] + stage["width"] / 2, stage["y"] + stage["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    clouds: list[tuple[int, float]] = []
    for seconds in (SETTLES_S, TURNS_S):
        page.evaluate("document.querySelector('[data-testid=viewport-frame]').contentWindow.clouds.length = 0")
        for step in range(int(seconds * STEPS)):
            page.mouse.move(x + 0.3 * stage["width"] * np.sin(step / 40), y + 0.1 * stage["height"] * np.sin(step / 60))
            page.wait_for_timeout(1000 / STEPS)
        clouds = page.evaluate("document.querySelector('[data-testid=viewport-frame]').contentWindow.clouds")
    page.mouse.up()
    page.context.close()
    return {
        "points": int(np.median([count for count, _ in clouds])),
        "frames_per_s": (len(clouds) - 1) / (clouds[-1][1] - clouds[0][1]) * 1000,
    }


# Takes the time of each drawing.
DRAWINGS = """() => {
  const ask = window.requestAnimationFrame.bind(window);
  window.drawings = [];
  window.requestAnimationFrame = (draw) => ask((now) => {
    const begin = performance.now();
    draw(now);
    window.drawings.push(performance.now() - begin);
  });
}"""


def timeline(browser: Browser, server: Server, project: str, frames: Sequence[int]) -> dict[str, Any]:
    """Time of a drawing of the timeline with 5,000 frames, 300 tracks and 130,000 boxes, zoomed, moved and scrolled.

    The answer about the tracks is made up; the frames behind the first few do not exist.
    """
    ids = [*frames, *range(10**6, 10**6 + 5000 - len(frames))]
    # a box is missing now and then; the doubt of proposals changes every few frames
    lanes = [
        {"track_id": n, "spans": [[at, at + 6, LABEL, at % 6] for at in range(15 * n, 15 * n + 500, 8)]}
        for n in range(300)
    ]
    page = signed_in(browser, server)
    page.add_init_script(f"({DRAWINGS})()")
    answer = {"recording": 1, "frames": ids, "lanes": lanes, "pictures": "v=1"}
    page.route("**/recordings/*/tracks", lambda route: route.fulfill(json=answer))
    open_frame(page, project, frames[0])
    strip, rows = (page.get_by_test_id(f"timeline-{part}").bounding_box() for part in ("strip", "lanes"))
    assert strip is not None and rows is not None
    page.evaluate("window.drawings.length = 0")
    for part, wheel in ((strip, (0, -120)), (rows, (0, 90)), (strip, (240, 0)), (strip, (0, 120))):
        page.mouse.move(part["x"] + 0.4 * part["width"], part["y"] + part["height"] / 2)
        for _ in range(15):
            page.mouse.wheel(*wheel)
            page.wait_for_timeout(50)
    times = page.evaluate("window.drawings")
    page.context.close()
    return {"drawings": len(times), **_percentiles(times)}


def tables(_: Arguments, result: dict[str, Any]) -> list[Table]:
    table = Table("part", "recording", "measure", "figure")
    for part, recordings in result.items():
        for name, figures in recordings.items():
            for measure, figure in figures.items():
                table.add(part, name, measure, figure)
    return [table]


main = program(Arguments, run, tables, __doc__)


if __name__ == "__main__":
    guarded(main)
