"""Takes the README's screenshots of the workbench: `python docs/make_screenshots.py DEMO_FOLDER`.

DEMO_FOLDER is created by `annotator demo DEMO_FOLDER --no-serve`. Needs the `test` extra and Chromium. The project is
copied first, so it does not change.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
import threading
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

from annotator.web.serve import Running
from annotator.web.settings import ServerSettings

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
        server = Running(ServerSettings(Path(folder), port=0))
        thread = threading.Thread(target=server.serve_until_stopped)
        thread.start()
        try:
            with sync_playwright() as driver:
                browser = driver.chromium.launch(executable_path=CHROMIUM, args=list(ARGS))
                for name, scheme, take in (("label", "light", label), ("review", "dark", review)):
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


def label(page: Page, address: str) -> None:
    """Label: the first frame, where the simulated operator has finished some objects; one of them is opened."""
    page.goto(f"{address}#/demo/label/1")
    page.get_by_test_id("object").first.click()
    page.get_by_test_id("view-side").locator("img.picture[src]").wait_for()
    wait_for_3d(page)


def review(page: Page, address: str) -> None:
    """Review: the second frame, which is unlabelled, with its first proposal."""
    page.goto(f"{address}#/demo/review/2")
    page.get_by_test_id("ortho-side").locator("rect.line").wait_for()
    page.keyboard.press("r")
    wait_for_3d(page)


def wait_for_3d(page: Page) -> None:
    page.locator('[data-testid="viewport"][data-state="ready"]').wait_for()
    page.wait_for_timeout(8_000)  # software rendering of the points is slow


if __name__ == "__main__":
    main(Path(sys.argv[1]))
