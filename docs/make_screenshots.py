"""Takes the README's screenshots of the workbench: `python docs/make_screenshots.py DEMO_FOLDER`.

DEMO_FOLDER is created by `annotator demo DEMO_FOLDER --no-serve`; its project is copied first, so it does not change.
Needs the base detector, the `test` extra and Chromium.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
import threading
from functools import partial
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

from annotator.geometry.oriented_box import contains
from annotator.geometry.outline import points_on_image
from annotator.project import BoxRotation, ProjectSettings, create_project
from annotator.recordings import open_recording
from annotator.web.serve import Running
from annotator.web.settings import ServerSettings
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.recorded.reading import load_truth

HERE = Path(__file__).resolve().parent
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
# The page itself is rendered without GL, so that only the 3D view uses the software GL.
ARGS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-gpu-compositing",
)
PATIENCE_MS = 120_000.0


def main(demo: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(demo / "demo", Path(folder) / "demo")
        drag = unlabelled_project(Path(folder), demo / "recording")
        server = Running(ServerSettings(Path(folder), port=0))
        thread = threading.Thread(target=server.serve_until_stopped)
        thread.start()
        try:
            with sync_playwright() as driver:
                browser = driver.chromium.launch(executable_path=CHROMIUM, args=list(ARGS))
                for name, scheme, take in (("label", "light", partial(label, drag=drag)), ("review", "dark", review)):
                    context = browser.new_context(viewport={"width": 1366, "height": 768}, color_scheme=scheme)
                    page = context.new_page()
                    page.set_default_timeout(PATIENCE_MS)
                    sign_in(page, server.address)
                    take(page, server.address)
                    page.screenshot(path=HERE / f"{name}.jpg", type="jpeg", quality=82)
                    context.close()
                browser.close()
        finally:
            server.should_exit = True
            thread.join()


def sign_in(page: Page, address: str) -> None:
    page.goto(address)
    page.get_by_test_id("operator-name").fill("Ada")
    page.keyboard.press("Enter")
    page.get_by_test_id("open-demo").wait_for()


def unlabelled_project(folder: Path, path: Path) -> tuple[float, float, float, float]:
    """Creates a project "people" with the recording and no labels.

    Returns:
        left, top, right and bottom of the rightmost object's points in the first frame, as shares of the image.
    """
    recording = open_recording(path)
    frame = recording.frame(0)
    truths = load_truth(recording, 0, frame)
    truth = max(truths, key=lambda each: each.box.center_m[0] / each.box.center_m[2])
    settings = ProjectSettings(rotation=BoxRotation.UPRIGHT)
    with create_project(folder, "people", (truth.label,), settings=settings) as project:
        register_recording(project, recording)
    inside = contains(truth.box, frame.cloud.xyz_m)
    box = points_on_image(frame.camera, frame.cloud.xyz_m[inside], truth.label)
    assert box is not None
    width, height = frame.camera.width_px, frame.camera.height_px
    return box.x_min / width, box.y_min / height, box.x_max / width, box.y_max / height


def label(page: Page, address: str, drag: tuple[float, float, float, float]) -> None:
    """Label: one box drawn on the image, and the suggested boxes on the views."""
    page.goto(f"{address}#/people/label/1")
    shown = page.get_by_test_id("image-editor").locator("img.picture[src]")
    shown.wait_for()
    place = shown.bounding_box()
    assert place is not None
    left, top, right, bottom = drag
    page.mouse.move(place["x"] + left * place["width"], place["y"] + top * place["height"])
    page.mouse.down()
    page.mouse.move(place["x"] + right * place["width"], place["y"] + bottom * place["height"], steps=8)
    page.mouse.up()
    page.get_by_test_id("view-side").locator(".box.suggested").wait_for()
    wait_for_3d(page)


def review(page: Page, address: str) -> None:
    """Review: a box that was followed into the fifth frame."""
    page.goto(f"{address}#/demo/review/5")
    page.get_by_test_id("ortho-side").locator("rect.line").wait_for()
    page.keyboard.press("r")
    wait_for_3d(page)


def wait_for_3d(page: Page) -> None:
    page.locator('[data-testid="viewport"][data-state="ready"]').wait_for()
    page.wait_for_timeout(8_000)  # software rendering of the points is slow


if __name__ == "__main__":
    main(Path(sys.argv[1]))
