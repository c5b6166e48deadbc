"""What all pictures of the workbench share: its server, a browser, the operator's mouse and keys, and small files."""

from __future__ import annotations

import io
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from annotator.types import Box2D, Camera
from annotator.web.security import ServerSettings, with_token
from annotator.web.serve import Running

DOCS = Path(__file__).resolve().parent.parent
REPOSITORY = DOCS.parent
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
# The page itself is rendered without GL, so that only the 3D view uses the software GL.
ARGS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-gpu-compositing",
)
PATIENCE_MS = 600_000.0
# Rendering the points in software is slow.
DRAWN_MS = 8_000
WIDTH, HEIGHT = 1366, 768

Point = tuple[float, float]
"""Pixels of the page, from its upper left corner."""


@contextmanager
def workbench(projects: Path, *recordings: Path) -> Iterator[str]:
    """Serves a folder of projects; gives the link."""
    server = Running(with_token(ServerSettings(projects, recordings, port=0)))
    thread = threading.Thread(target=server.serve_until_stopped)
    thread.start()
    try:
        yield server.link()
    finally:
        server.should_exit = True
        thread.join()


@contextmanager
def chromium() -> Iterator[Browser]:
    """A headless browser."""
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=list(ARGS))
        yield browser
        browser.close()


def signed_in(browser: Browser, address: str) -> Page:
    """The start page, for the operator Ada."""
    page = browser.new_context(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme="light").new_page()
    page.set_default_timeout(PATIENCE_MS)
    page.goto(address)
    page.get_by_test_id("operator-name").fill("Ada")
    page.keyboard.press("Enter")
    page.get_by_test_id("new-project").first.wait_for()
    return page


def go_to(page: Page, place: str) -> None:
    """Opens a place of the page, such as `room/annotate`; the link would sign in once more, and lead to the start."""
    page.evaluate("place => { location.hash = `/${place}`; }", place)


def corners_on_page(page: Page, editor: str, box: Box2D, camera: Camera) -> tuple[Point, Point]:
    """The upper left and the lower right corner of a box on a picture of the page, pixels of the page."""
    shown = page.get_by_test_id(editor).locator("img.picture[src]")
    shown.wait_for()
    place = shown.bounding_box()
    assert place is not None
    x, y = place["width"] / camera.width_px, place["height"] / camera.height_px
    left, top = place["x"] + 0.5 * x, place["y"] + 0.5 * y
    return (left + box.x_min * x, top + box.y_min * y), (left + box.x_max * x, top + box.y_max * y)


def drag(page: Page, start: Point, end: Point) -> None:
    """Drags with the left mouse button."""
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(*end, steps=8)
    page.mouse.up()


def wait_for_3d(page: Page) -> None:
    """Waits until the 3D view shows the frame."""
    page.locator('[data-testid="viewport"][data-state="ready"]').wait_for()
    page.wait_for_timeout(DRAWN_MS)


def shot(page: Page) -> Image.Image:
    """The page as a picture."""
    return Image.open(io.BytesIO(page.screenshot())).convert("RGB")


def save_jpeg(picture: Image.Image, path: Path, width: int, most_bytes: int) -> None:
    """Writes a picture as JPEG, no wider than `width`, in the best quality with at most so many bytes.

    Raises:
        ValueError: it would look bad.
    """
    if picture.width > width:
        picture = picture.resize((width, round(picture.height * width / picture.width)), Image.Resampling.LANCZOS)
    for quality in range(90, 49, -4):
        data = io.BytesIO()
        picture.save(data, "JPEG", quality=quality, optimize=True)
        if data.tell() <= most_bytes:
            path.write_bytes(data.getvalue())
            return
    raise ValueError(f"{path.name} needs more than {most_bytes} bytes; show less, or make it narrower")
