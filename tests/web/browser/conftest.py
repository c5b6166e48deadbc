"""Fixtures for tests in a real browser: headless Chromium with software WebGL against the live server.

A failed test leaves a screenshot and the console output of each page in `out/screenshots` (ignored by git). An
uncaught error in a page fails the test.

All tests of a process share a browser, a server (`shop`) and its pages (`shared_page`; `shared_page_3d` with the 3D
view); each test has its own project, a copy of one that was made once. On the pages, Grace works; Ada is the signed-in
client of the server, another operator. `open_page()` opens further pages in contexts of their own.
"""

from __future__ import annotations

import asyncio
import os
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import pytest
from browser_page import FRAME, Bench, Desk, begin, propose, sign_in
from drawing import Scene
from job_threads import WorkerThread
from live_server import Live, running
from room_api import rig_settings

from annotator.project import Project, create_project
from annotator.recordings import open_recording
from annotator.types import BoxKind, DetectorKind
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.workbench.loaded_detectors import Readiness, ReadyDetector
from benchmarks.served import ARGS, VIEWPORT

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

SCREENSHOTS = Path(__file__).resolve().parents[3] / "out" / "screenshots"
CHROMIUM_NAMES = ("chromium", "chromium-browser", "google-chrome")
# Long, since the 3D view is rendered in software, possibly on a busy machine.
TIMEOUT_MS = 120_000.0
# For tests without the 3D view, which spend most of their time in software WebGL otherwise.
NO_WEBGL = "HTMLCanvasElement.prototype.getContext = () => null;"
IS_CLEAN = """!document.querySelector("dialog[open]")
  && dispatchEvent(new Event("beforeunload", { cancelable: true }))"""

OPERATOR = "Grace"
outcome_key = pytest.StashKey[bool]()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    """Records that a test failed, for the teardown of its fixtures."""
    report = yield
    if report.failed:
        item.stash[outcome_key] = True
    return report


def find_chromium() -> str | None:
    """The browser: ANNOTATOR_CHROMIUM, or the first one on the PATH."""
    named = os.environ.get("ANNOTATOR_CHROMIUM")
    return named or next(filter(None, map(shutil.which, CHROMIUM_NAMES)), None)


@pytest.fixture(scope="session")
def _running_browser() -> Iterator[tuple[Browser, asyncio.AbstractEventLoop]]:
    """One headless Chromium for all tests of a process, and the event loop that Playwright keeps running."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed; run scripts/setup test"
    )
    chromium = find_chromium()
    if chromium is None:
        pytest.skip(f"none of {', '.join(CHROMIUM_NAMES)} on the path; install chromium, or set ANNOTATOR_CHROMIUM")
    playwright.expect.set_options(timeout=TIMEOUT_MS)
    driver = playwright.sync_playwright().start()
    browser = driver.chromium.launch(executable_path=chromium, args=[*ARGS, "--disable-background-networking"])
    loop = asyncio.get_running_loop()
    asyncio._set_running_loop(None)
    yield browser, loop
    asyncio._set_running_loop(loop)
    browser.close()
    driver.stop()


@pytest.fixture(scope="module")
def browser(_running_browser: tuple[Browser, asyncio.AbstractEventLoop]) -> Iterator[Browser]:
    """The browser. Its event loop counts as running only in the files of these tests: others start their own."""
    browser, loop = _running_browser
    asyncio._set_running_loop(loop)
    yield browser
    asyncio._set_running_loop(None)


@pytest.fixture
def open_page(browser: Browser, live: Live, request: pytest.FixtureRequest) -> Iterator[Callable[..., Page]]:
    """`open_page()`: a new page in its own context; `page.goto("/")` opens the start page of `live`.

    Keyword arguments are passed to `Browser.new_context`. Errors raised in a page are in `page.errors`; clear the list
    in a test that expects one.
    """
    pages: list[Page] = []

    def open_one(**options: object) -> Page:
        pages.append(_new_page(browser, live.url, **options))
        return pages[-1]

    yield open_one
    errors = _collect_errors(pages, request.node)
    for page in pages:
        page.context.close()
    assert not errors, f"a page raised {errors}; screenshots are in {SCREENSHOTS}"


@dataclass(eq=False)
class Shop:
    """The server shared by all tests of a process.

    Attributes:
        recording: of people, 5 frames.
        folder: its folder of recordings that tests may add to.
        templates: projects that are copied: `plain` has the recording, `proposed` proposals on it, too.
        projects: those of the present test.
        pages: keyed by whether they have the 3D view.
    """

    live: Live
    recording: Path
    folder: Path
    templates: Path
    projects: list[str] = field(default_factory=list)
    pages: dict[bool, Page] = field(default_factory=dict)
    number: int = 0

    def new_project(self, template: str = "plain", name: str = "") -> Project:
        """A new project of the server with 5 frames of people."""
        self.number += 1
        name = name or f"room{self.number}"
        root = self.live.settings.projects_root
        shutil.copytree(self.templates / template, root / f".{name}")
        config = root / f".{name}" / "project.json"
        config.write_text(config.read_text().replace(f'"name": "{template}"', f'"name": "{name}"'))
        (root / f".{name}").rename(root / name)
        self.projects.append(name)
        return self.live.context.project(name)

    def clear(self) -> None:
        """Removes the projects of a test."""
        for name in self.projects:
            if (self.live.settings.projects_root / name).exists():
                self.live.client.delete(f"/api/projects/{name}")
        self.projects.clear()


@pytest.fixture(scope="session")
def _server(
    generated: Path,
    made_once: Callable[[str, Callable[[Path], object]], Path],
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Shop]:
    recording = generated / "people"

    def fill(folder: Path) -> None:
        for name in ("plain", "proposed"):
            with create_project(folder, name, ("person",)) as project:
                register_recording(project, open_recording(recording))
                if name == "proposed":
                    propose(project, recording)

    settings = rig_settings(tmp_path_factory.mktemp("shop"))
    (folder,) = settings.folders
    with running(replace(settings, folders=(generated, folder))) as live:
        yield Shop(live, recording, folder, made_once("browser_projects", fill))


@pytest.fixture
def shop(_server: Shop, browser: Browser, monkeypatch: pytest.MonkeyPatch) -> Iterator[Shop]:
    """The shared server, with jobs in threads; the test's projects are removed after it."""
    monkeypatch.setattr("annotator.web.jobs.runner.WorkerProcess", WorkerThread)
    yield _server
    _server.clear()


@pytest.fixture
def live(shop: Shop) -> Live:
    """The shared server."""
    return shop.live


@pytest.fixture
def shared_page(shop: Shop, browser: Browser, request: pytest.FixtureRequest) -> Iterator[Page]:
    """The shared page without the 3D view, reset after each test."""
    yield from _shared(shop, browser, request, with_3d=False)


@pytest.fixture
def shared_page_3d(shop: Shop, browser: Browser, request: pytest.FixtureRequest) -> Iterator[Page]:
    """Like `shared_page`, with the 3D view."""
    yield from _shared(shop, browser, request, with_3d=True)


@pytest.fixture
def start(shared_page: Page) -> Page:
    """The start page, which lists the projects that the test has made before."""
    shared_page.goto("/#/")
    shared_page.reload()
    shared_page.get_by_test_id("new-project").first.wait_for()
    return shared_page


@pytest.fixture
def room(shop: Shop) -> Project:
    """A new project on the shared server."""
    return shop.new_project()


@pytest.fixture
def desk(shared_page: Page, shop: Shop) -> Desk:
    """A new project with proposals, without the 3D view; the most doubtful proposal is selected."""
    return begin(shared_page, shop)


@pytest.fixture
def desk_3d(shared_page_3d: Page, shop: Shop) -> Desk:
    """Like `desk`, with the 3D view."""
    desk = begin(shared_page_3d, shop)
    desk.page.locator('[data-testid=viewport][data-state="ready"]').wait_for()
    return desk


@pytest.fixture
def bench(shared_page: Page, shop: Shop) -> Bench:
    """A frame without labels, with the pseudo-views, without the 3D view."""
    project = shop.new_project()
    shared_page.goto(f"/#/{project.path.name}/annotate/{FRAME}")
    shown = f"img.picture[src*='/{project.path.name}/frames/{FRAME}/']"
    shared_page.get_by_test_id("image-editor").locator(shown).wait_for()
    shared_page.get_by_test_id("views-pseudo").click()
    return Bench(shared_page, shop.live, project, Scene.of(shop.recording, 0, ("person",)))


@pytest.fixture
def teach(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """`teach(image=..., view=...)`: gives the project detectors, and reloads the page."""

    def taught(class_agnostic: bool = False, name: str = "", **detectors: Any) -> None:
        ready = {
            DetectorKind(role): Readiness(
                "ready", ReadyDetector(detector, BoxKind.SILHOUETTE, Lock(), class_agnostic, name)
            )
            for role, detector in detectors.items()
        }
        look = lambda project, role, wait_s=None: ready.get(role, Readiness("none"))  # noqa: E731
        monkeypatch.setattr(bench.live.context.caches.detectors, "readiness", look)
        info = bench.live.client.get(bench.api).json()
        models = {role: {"id": 1} if role in detectors else None for role in ("image", "view")}
        bench.page.route(f"**{bench.api}", lambda route: route.fulfill(json={**info, "detectors": models}))
        bench.page.reload()
        bench.page.get_by_test_id("image-editor").locator("img.picture[src]").wait_for()
        bench.page.get_by_test_id("views-pseudo").click()

    return taught


def _shared(shop: Shop, browser: Browser, request: pytest.FixtureRequest, with_3d: bool) -> Iterator[Page]:
    if with_3d not in shop.pages:
        page = shop.pages[with_3d] = _new_page(browser, shop.live.url)
        if not with_3d:
            page.add_init_script(NO_WEBGL)
        sign_in(page, shop.live.url, OPERATOR)
    page = shop.pages[with_3d]
    yield page
    errors = _collect_errors([page], request.node)
    # the 3D view would go on drawing
    if errors or with_3d or request.node.stash.get(outcome_key, False):
        shop.pages.pop(with_3d).context.close()
    else:
        _reset(page)
    assert not errors, f"the page raised {errors}; a screenshot is in {SCREENSHOTS}"


def _reset(page: Page) -> None:
    page.unroute_all(behavior="ignoreErrors")
    if page.url == "about:blank":
        return
    page.evaluate("localStorage.clear()")
    page.evaluate("document.getElementById('toasts').replaceChildren()")
    page.said.clear()
    page.goto("/#/" if page.evaluate(IS_CLEAN) else "about:blank")


def _new_page(browser: Browser, url: str, **options: object) -> Page:
    settings: dict = {"base_url": url, "viewport": VIEWPORT, "accept_downloads": True, **options}
    page = browser.new_context(**settings).new_page()
    page.set_default_timeout(TIMEOUT_MS)
    page.errors, page.said = [], []
    page.on("pageerror", lambda error: page.errors.append(str(error)))
    page.on("console", lambda message: page.said.append(f"{message.type}: {message.text}"))
    return page


def _collect_errors(pages: list[Page], test: pytest.Item) -> list[str]:
    """Returns errors raised in pages; saves screenshots if there are any, or if the test failed."""
    errors = [error for page in pages for error in page.errors]
    if errors or test.stash.get(outcome_key, False):
        _save_screenshots(pages, test.nodeid)
    return errors


def _save_screenshots(pages: list[Page], test: str) -> None:
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    name = re.sub(r"[^\w.-]+", "_", test)
    for number, page in enumerate(pages):
        stem = SCREENSHOTS / f"{name}.{number}"
        try:
            page.screenshot(path=stem.with_suffix(f"{stem.suffix}.png"))
        except Exception as error:  # a crashed or closed page has no screenshot, but its console output is saved
            page.said.append(f"no screenshot: {error}")
        stem.with_suffix(f"{stem.suffix}.txt").write_text("\n".join([page.url, *page.errors, *page.said]) + "\n")
