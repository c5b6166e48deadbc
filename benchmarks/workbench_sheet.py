"""How long a contact sheet takes to open in a real browser, on a server that has drawn nothing yet."""

from __future__ import annotations

import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Any

from annotator.project import create_project
from annotator.project.log.event_types import LabelProposed
from annotator.project.log.records import BoxRecord
from annotator.recordings import open_recording
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.tracks.propose_boxes import part_of
from benchmarks.workbench_browser import OPENS_WITHIN_S, signed_in, until
from benchmarks.workbench_server import Server

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

TRACK = 1

# Records in `window.sheet`, from the key S on: when the tiles on the screen are drawn, and when all are, seconds.
PROBE = """(boxes) => {
  window.sheet = { screen_s: null, all_s: null };
  window.began.keydown = null;
  const isDrawn = (image) => image.complete && image.naturalWidth > 0;
  const isOnScreen = (image) => {
    const { top, bottom } = image.getBoundingClientRect();
    return bottom > 0 && top < innerHeight;
  };
  const tick = () => {
    const images = [...document.querySelectorAll(".sheet img")];
    const passed_s = (performance.now() - window.began.keydown) / 1000;
    if (images.length === boxes && images.filter(isOnScreen).every(isDrawn)) window.sheet.screen_s ??= passed_s;
    if (images.length === boxes && images.every(isDrawn)) window.sheet.all_s = passed_s;
    else requestAnimationFrame(tick);
  };
  requestAnimationFrame(tick);
}"""


def make_track(projects: Path, name: str, label: str, path: Path) -> int:
    """Creates a project with the first object of each frame as proposals of one track; returns the first frame's id."""
    recording = open_recording(path)
    with create_project(projects, name, (label,)) as project:
        register_recording(project, recording)
        frames = project.frames.of()
        parts = []
        for index, frame in enumerate(frames):
            truth = load_truth(recording, index, recording.frame(index))[0]
            proposed = LabelProposed(uid=uuid.uuid4().hex, label=label, box=BoxRecord.of(truth.box), track_id=TRACK)
            parts.append(part_of(frame, [proposed], "benchmark"))
        project.log.append_to_frames(parts)
        return frames[0].id


def opened(browser: Browser, server: Server, project: str, frame: int, boxes: int, pause_s: float) -> dict[str, Any]:
    """Opens a track's sheet twice.

    Args:
        pause_s: how long the operator looks at the box before.
    """
    page = signed_in(browser, server)
    page.goto(f"/#/{project}/review/{frame}")
    page.reload()
    until(page, "document.querySelectorAll('[data-testid=track-tick]').length > 0", OPENS_WITHIN_S)
    page.wait_for_timeout(pause_s * 1000)
    first = _timed(page, boxes)
    page.keyboard.press("Escape")
    until(page, "document.querySelector('.sheet') === null", OPENS_WITHIN_S)
    again = _timed(page, boxes)
    page.context.close()
    return {"first": first, "again": again}


def _timed(page: Page, boxes: int) -> dict[str, float]:
    page.evaluate(PROBE, boxes)
    page.keyboard.press("s")
    until(page, "window.sheet.all_s !== null", OPENS_WITHIN_S)
    times: dict[str, float] = page.evaluate("({ screen_s: window.sheet.screen_s, all_s: window.sheet.all_s })")
    return times
