"""The workbench's requirements: the operator's waiting times, and that no saved edit is lost.

python -m benchmarks.workbench [--only switch,views,drag,sheet,million,kill,clients] [--json]

The browser is headless Chromium, which renders WebGL in software. On a computer with a graphics card the 3D view is
faster.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import tyro

from annotator.detection.pretrained import base_weights
from annotator.types.errors import ConfigError
from benchmarks import workbench_browser, workbench_edits, workbench_sheet
from benchmarks.keystrokes import M
from benchmarks.report import Table, finish, guarded
from benchmarks.workbench_drag import first_drags
from benchmarks.workbench_server import LABEL, PRESET, make_people, make_project, serving

PARTS = ("switch", "views", "drag", "sheet", "million", "kill", "clients")
KITTI = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc")
# A depth image of this size has a million valid points.
MILLION_PX = (1280, 800)


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
    sheet_boxes: int = 100
    """Number of boxes on the contact sheet."""
    kills: int = 50
    """How often the server is killed."""
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
    measures = (
        measure_switch,
        measure_views,
        measure_drag,
        measure_sheet,
        measure_million,
        measure_kill,
        measure_clients,
    )
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
    with serving(projects) as server, workbench_browser.chromium() as browser:
        return {
            name: workbench_browser.switch(
                browser, server, name, workbench_browser.frames_of(projects, name), args.switches
            )
            for name in available
        }


def measure_views(args: Arguments, folder: Path) -> dict[str, Any]:
    """Draws image boxes around true objects, on unlabelled frames."""
    projects, recording = folder / "views", _people(args, folder)
    make_project(projects, "views", (LABEL,), [recording])
    boxes = _true_boxes(projects, "views", recording)
    with serving(projects) as server, workbench_browser.chromium() as browser:
        return workbench_browser.views(browser, server, "views", boxes[: args.boxes])


def measure_drag(args: Arguments, folder: Path) -> dict[str, Any]:
    """Draws image boxes that the base detector completes.

    Raises:
        DetectionError: this installation has no base detector.
    """
    base_weights()
    projects = folder / "drag"
    recordings = {"rgbd": _people(args, folder), **{n: args.shared / "data" / n for n in ("kitti", "hand_gesture")}}
    classes = {"rgbd": (LABEL,), "kitti": KITTI, "hand_gesture": ("hand",)}
    available = {name: path for name, path in recordings.items() if path.is_dir()}
    for name, path in available.items():
        make_project(projects, name, classes[name], [path])
    with serving(projects) as server, workbench_browser.chromium() as browser:
        return {
            name: first_drags(browser, server, name, _true_boxes(projects, name, path)[: args.boxes])
            for name, path in available.items()
        }


def _true_boxes(projects: Path, name: str, path: Path) -> list[tuple[int, tuple[float, float, float, float]]]:
    """The frame's id and the edges on the image of each visible object of a project's recording."""
    from annotator.geometry.outline import box_on_image
    from annotator.recordings import open_recording
    from annotator.workflows.recorded.reading import load_truth

    recording = open_recording(path)
    boxes = []
    for index, frame_id in enumerate(workbench_browser.frames_of(projects, name)):
        frame = recording.frame(index)
        for truth in load_truth(recording, index, frame):
            box = box_on_image(frame.camera, truth.box, truth.label, 20)
            if box is not None:
                boxes.append((frame_id, box.xyxy))
    return boxes


def measure_sheet(args: Arguments, folder: Path) -> dict[str, Any]:
    """Opens the contact sheet of a long track: at once, and after the operator has looked at the selected box."""
    recording = make_people(folder / "long", args.sheet_boxes, 640, 480)
    result = {}
    for name, pause_s in (("at_once", 0.0), ("after_a_look", M)):
        projects = folder / f"sheet-{name}"
        frame = workbench_sheet.make_track(projects, "sheet", LABEL, recording)
        with serving(projects) as server, workbench_browser.chromium() as browser:
            result[name] = workbench_sheet.opened(browser, server, "sheet", frame, args.sheet_boxes, pause_s)
    return result


def measure_million(args: Arguments, folder: Path) -> dict[str, Any]:
    """Opens a frame of a million points after a small one."""
    projects = folder / "million"
    small, large = make_people(folder / "small", 1, 320, 240), make_people(folder / "large", 1, *MILLION_PX)
    make_project(projects, "million", (LABEL,), [small, large])
    first, second = workbench_browser.frames_of(projects, "million")
    with serving(projects) as server, workbench_browser.chromium() as browser:
        return workbench_browser.million(browser, server, "million", first, second)


def measure_kill(args: Arguments, folder: Path) -> dict[str, Any]:
    """Kills the server with `kill -9` during a scripted series of edits."""
    projects = folder / "kill"
    make_project(projects, "kill", (LABEL,), [_people(args, folder)])
    return workbench_edits.kill(projects, "kill", workbench_browser.frames_of(projects, "kill")[0], args.kills)


def measure_clients(args: Arguments, folder: Path) -> dict[str, Any]:
    """Lets many operators edit one frame."""
    projects = folder / "clients"
    make_project(projects, "clients", (LABEL,), [_people(args, folder)])
    frame = workbench_browser.frames_of(projects, "clients")[0]
    with ExitStack() as stack:
        server = stack.enter_context(serving(projects))
        browser = stack.enter_context(workbench_browser.chromium())
        return workbench_edits.clients(browser, server, "clients", frame, args.clients, args.edits)


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
