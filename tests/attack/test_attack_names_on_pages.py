"""Names with markup and script in them, on every page of the workbench in Chromium: text stays text."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import pytest
from browser_page import label_truth, sign_in, until
from live_server import running

from annotator.project import create_project
from annotator.recordings import open_recording
from annotator.web.security import ServerSettings
from annotator.workflows.add_recordings import register_recording
from benchmarks.served import chromium

if TYPE_CHECKING:
    from live_server import Live
    from playwright.sync_api import Browser, Page

# An attribute that runs without a click, and a harmless element that is counted where the policy stops the script.
MARK = "<img src=x onerror=hacked=1><b class=hacked>"
CLASSES = ("person", "<b class=hacked>")
HERE = quote(MARK, safe="")
PLACES = (
    "/#/",
    "/#/room/label/1",
    "/#/room/review/1",
    "/#/room/train",
    "/#/room/export",
    "/#/room/statistics",
    "/#/room/checks",
    "/#/room/alignment/1",
    "/#/broken/label",
    f"/#/{HERE}",
    f"/#/room/{HERE}",
    f"/#/room/label/{HERE}",
    f"/#/room/review/1?uid={HERE}",
    f"/#/{MARK}/label",
    "/#/room/review/999",
    f"/?go={HERE}",
    f"/{HERE}",
    f"/api/projects/{HERE}",
)
STARTED = "document.readyState === 'complete'"
TRACES = "[typeof hacked, document.querySelectorAll('.hacked, img[src=x], [onerror]').length].join()"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """One headless Chromium."""
    with chromium() as found:
        yield found


@pytest.fixture
def marked(generated: Path, tmp_path: Path) -> Iterator[Live]:
    """A server on whose pages the markup is in every name that others can choose."""
    folder = tmp_path / MARK.replace("/", "")
    shutil.copytree(generated / "people", folder)
    projects = tmp_path / "projects"
    with create_project(projects, "room", CLASSES) as project:
        register_recording(project, open_recording(folder))
        label_truth(project, generated / "people", 3)
    (projects / "broken").mkdir()
    (projects / "broken/project.json").write_text(json.dumps({MARK: MARK}))
    with running(ServerSettings(projects, (folder, tmp_path), port=0)) as live:
        # jobs whose messages and authors have the markup
        live.client.post("/api/session", json={"operator": MARK})
        for body in ({"kind": "export", "format": "kitti", "classes": [CLASSES[1]]}, {"kind": "propose"}):
            live.client.post("/api/projects/room/jobs", json=body)
        live.client.post("/api/projects/room/undo", json={})
        yield live


def test_names_are_text_on_every_page(browser: Browser, marked: Live) -> None:
    page = browser.new_context(base_url=marked.url).new_page()
    for cookie in marked.client.cookies.jar:
        page.context.add_cookies([{"name": cookie.name, "value": cookie.value or "", "url": marked.url}])
    sign_in(page, marked.url, MARK)
    page.route("**/api/workbench", lambda route: route.abort())
    violations: list[str] = []
    page.on("console", lambda message: violations.append(message.text) if "Content Security" in message.text else None)
    page.on("dialog", lambda dialog: violations.append(f"a dialog: {dialog.message}"))
    shown = ""
    for place in PLACES:
        page.goto("about:blank")
        page.goto(place)
        until(page, STARTED)
        page.wait_for_load_state("networkidle")
        shown += page.inner_text("body")
        assert _traces(page) == "undefined,0", place
        for key in ("?", "Tab", "l", "Escape"):
            page.keyboard.press(key)
        assert _traces(page) == "undefined,0", place
    # otherwise the names are not on the pages, and nothing was tested
    assert shown.count(MARK[:20]) > 5, shown
    assert CLASSES[1] in shown
    assert violations == [], violations
    page.context.close()


def _traces(page: Page) -> str:
    found: str = page.evaluate(TRACES)
    return found
