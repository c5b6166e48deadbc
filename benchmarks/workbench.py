"""The workbench's requirements: the operator's waiting times, and that no saved edit is lost.

python -m benchmarks.workbench [--only switch,views,clients] [--json]

The browser is headless Chromium, which renders WebGL in software. On a computer with a graphics card the 3D view is
faster.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from annotator.types.errors import ConfigError
from benchmarks.report import Table, finish, guarded
from benchmarks.workbench_browser import (
    CLOUD_BYTES,
    CLOUD_PROBE,
    chromium,
    draw_box,
    frames_of,
    measured,
    open_mode,
    signed_in,
    wait_for_frame,
    watch,
)
from benchmarks.workbench_edits import clients
from benchmarks.workbench_server import LABEL, PRESET, Server, make_people, make_project, percentile, serving

if TYPE_CHECKING:
    from playwright.sync_api import Browser

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
