"""The operator's waiting times in the browser.

python -m benchmarks.workbench [--only switch,views,timeline] [--json]

The browser is headless Chromium, which renders WebGL in software. On a computer with a graphics card the 3D view is
faster.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from annotator.geometry.outline import box_on_image
from annotator.project import create_project
from annotator.recordings import open_recording
from annotator.synthetic import write_generated
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

PARTS = ("switch", "views", "timeline")
KITTI = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc")


@dataclass
class Arguments(Options):
    only: str = ",".join(PARTS)
    """Parts to measure, separated by commas."""
    frames: int = 12
    """Number of frames of the generated 640 x 480 recording."""
    switches: int = 60
    """Number of frame switches on each recording."""
    boxes: int = 24
    """Number of image boxes to draw."""
    shared: Path = Path(os.environ.get("ANNOTATOR_SHARED", "../shared"))
    """Folder with `data/kitti`, KITTI object frames with whole scans; KITTI is skipped if it is missing."""


def run(args: Arguments) -> dict[str, Any]:
    """Milliseconds by part and recording, as `--json` prints them."""
    parts = chosen("--only", args.only, PARTS)
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        projects, people, kitti = folder / "projects", folder / PRESET, args.shared / "data" / "kitti"
        write_generated(people, PRESET, args.frames, 0, 640, 480)
        recordings = {"rgbd": (people, (LABEL,)), **({"kitti": (kitti, KITTI)} if kitti.is_dir() else {})}
        for name, (path, classes) in recordings.items():
            with create_project(projects, name, classes) as project:
                register_recording(project, open_recording(path))
        result: dict[str, Any] = {}
        with serving(projects) as server, chromium() as browser:
            if "switch" in parts:
                frames = {name: frames_of(projects, name) for name in recordings}
                result["switch"] = {name: switch(browser, server, name, frames[name], args.switches) for name in frames}
            if "views" in parts:
                boxes = _true_boxes(projects, "rgbd", people)[: args.boxes]
                result["views"] = {"rgbd": views(browser, server, "rgbd", boxes)}
            if "timeline" in parts:
                result["timeline"] = {"rgbd": timeline(browser, server, "rgbd", frames_of(projects, "rgbd"))}
        return result


def _true_boxes(projects: Path, name: str, path: Path) -> list[tuple[int, tuple[float, float, float, float]]]:
    """The frame's id and the edges on the image of each visible object of a project's recording."""
    recording = open_recording(path)
    boxes = []
    for index, frame_id in enumerate(frames_of(projects, name)):
        frame = recording.frame(index)
        for truth in load_truth(recording, index, frame):
            box = box_on_image(frame.camera, truth.box, truth.label, 20)
            if box is not None:
                boxes.append((frame_id, box.xyxy))
    return boxes


def switch(browser: Browser, server: Server, project: str, frames: Sequence[int], rounds: int) -> dict[str, Any]:
    """Time from the key N or P until the new frame's image and cloud are on screen."""
    page = signed_in(browser, server)
    open_frame(page, project, frames[0])
    page.evaluate(CLOUD_PROBE, CLOUD_BYTES)
    times: list[dict[str, float]] = []
    keys = ["n"] * (len(frames) - 1) + ["p"] * (len(frames) - 1)
    for number in range(rounds):
        watch(page, "keydown", "[data-testid=image-editor] img.picture", True)
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
    """Time from the release of the mouse after drawing an image box until its two pseudo-views are on screen.

    A box is a frame, and x_min, y_min, x_max, y_max on its image, pixels.
    """
    page = signed_in(browser, server)
    open_frame(page, project, boxes[0][0])
    page.keyboard.press("d")
    times = []
    for frame, box in boxes:
        page.evaluate("(hash) => (location.hash = hash)", f"#/{project}/annotate/{frame}")
        wait_for_frame(page, frame)
        watch(page, "pointerup", ".views img.picture", False)
        draw_box(page, box)
        times.append(measured(page)["picture"])
        page.wait_for_timeout(300)
    page.context.close()
    return {"boxes": len(times), "p50_ms": percentile(times, 50), "p95_ms": percentile(times, 95)}


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
    return {"drawings": len(times), "p50_ms": percentile(times, 50), "p95_ms": percentile(times, 95)}


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
