"""Fixtures for tests in a real browser: headless Chromium with software WebGL against the live server.

`open_page()` gives pages of their own browser context (an own operator, own cookies), `page` is one of them. A test
that fails leaves a screenshot of each page, and what the pages said on their console, under `out/screenshots` (git
ignores it). A page that raised an error nobody caught fails its test.

Most tests need neither a server nor a page of their own: `shop` is a file's one server, where each test makes itself a
project, and `shared_page` its one page, without the 3D view (`shared_page_3d`: with it).
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from browser_page import sign_in
from live_server import Live, running
from review_desk import Desk, begin

from annotator.project import Project, create_project
from annotator.recordings import open_recording
from annotator.web.settings import ServerSettings
from annotator.workflows.add_recordings import register_recording

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

SCREENSHOTS = Path(__file__).resolve().parents[3] / "out" / "screenshots"
CHROMIUM_NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM_ARGS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    # as a browser without a graphics card does it: only WebGL goes through the software GL, the page itself does not
    "--disable-gpu-compositing",
    "--disable-background-networking",
)
VIEWPORT = {"width": 1366, "height": 768}
# A limit for what hangs: software draws the 3D view, beside whatever else the machine does.
TIMEOUT_MS = 120_000.0
# Software WebGL would take most of the time of tests that look at no 3D view.
NO_WEBGL = "HTMLCanvasElement.prototype.getContext = () => null;"
IS_CLEAN = """!document.querySelector("dialog[open]")
  && dispatchEvent(new Event("beforeunload", { cancelable: true }))"""

outcome_key = pytest.StashKey[bool]()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    """Remembers that a test failed, for the fixtures that are torn down after it."""
    report = yield
    if report.failed:
        item.stash[outcome_key] = True
    return report


def find_chromium() -> str | None:
    """The browser: named by ANNOTATOR_CHROMIUM, or the first on the path."""
    named = os.environ.get("ANNOTATOR_CHROMIUM")
    return named or next(filter(None, map(shutil.which, CHROMIUM_NAMES)), None)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """One headless Chromium for the tests of a file.

    Not for the session: while it runs, Playwright keeps an event loop in this thread, in which no other test could
    start its own.
    """
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed; run scripts/setup test"
    )
    chromium = find_chromium()
    if chromium is None:
        pytest.skip(f"none of {', '.join(CHROMIUM_NAMES)} on the path; install chromium, or set ANNOTATOR_CHROMIUM")
    playwright.expect.set_options(timeout=TIMEOUT_MS)
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=list(CHROMIUM_ARGS))
        yield browser
        browser.close()


@pytest.fixture
def open_page(browser: Browser, live, request: pytest.FixtureRequest) -> Iterator[Callable[..., Page]]:
    """`open_page()` -> a new page in a context of its own; `page.goto("/")` is the live server's start page.

    Keyword arguments go to `Browser.new_context` (`color_scheme="dark"`, another `viewport` ...). Errors that a page
    raised are in `page.errors`; clear the list in a test that expects one.
    """
    pages: list[Page] = []

    def open_one(**options: object) -> Page:
        pages.append(_new_page(browser, live.url, **options))
        return pages[-1]

    yield open_one
    errors = _look_back(pages, request.node)
    for page in pages:
        page.context.close()
    assert not errors, f"a page raised {errors}; screenshots are in {SCREENSHOTS}"


@pytest.fixture
def page(open_page: Callable[..., Page]) -> Page:
    """One page, 1366 x 768."""
    return open_page()


@dataclass(eq=False)
class Shop:
    """A file's server, and its pages once tests have asked for them, by whether they have the 3D view."""

    live: Live
    recording: Path
    projects: int = 0
    pages: dict[bool, Page] = field(default_factory=dict)

    def new_project(self, recording: Path | None = None) -> Project:
        """A project with 5 frames of people, none labelled; of the file's recording, or of one of the test's own."""
        self.projects += 1
        name = f"room{self.projects}"
        with create_project(self.live.settings.projects_root, name, ("person",)) as project:
            register_recording(project, open_recording(recording or self.recording))
        return self.live.context.project(name)


@pytest.fixture(scope="module")
def shop(browser: Browser, generated: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shop]:
    """One server for the tests of a file."""
    settings = ServerSettings(tmp_path_factory.mktemp("shop") / "projects", (generated,), port=0)
    settings.projects_root.mkdir()
    with running(settings) as live:
        shop = Shop(live, generated / "people")
        yield shop
        for page in shop.pages.values():
            page.context.close()


@pytest.fixture
def shared_page(shop: Shop, browser: Browser, request: pytest.FixtureRequest) -> Iterator[Page]:
    """The file's one page, without the 3D view; the test before has left no trace in it."""
    yield from _shared(shop, browser, request, with_3d=False)


@pytest.fixture
def shared_page_3d(shop: Shop, browser: Browser, request: pytest.FixtureRequest) -> Iterator[Page]:
    """The same with the 3D view."""
    yield from _shared(shop, browser, request, with_3d=True)


@pytest.fixture
def signed_in(shared_page_3d: Page, shop: Shop) -> Page:
    """The file's one page, signed in as Ada."""
    sign_in(shared_page_3d, shop.live.url)
    return shared_page_3d


@pytest.fixture
def room(shop: Shop) -> Project:
    """A project of the test's own on the file's server."""
    return shop.new_project()


@pytest.fixture
def desk(shared_page: Page, shop: Shop) -> Desk:
    """A signed-in operator in Review of a project with proposals; the worst one is selected. Without the 3D view."""
    return begin(shared_page, shop)


@pytest.fixture
def desk_3d(shared_page_3d: Page, shop: Shop) -> Desk:
    """The same with the 3D view."""
    desk = begin(shared_page_3d, shop)
    desk.page.locator('[data-testid=viewport][data-state="ready"]').wait_for()
    return desk


def _shared(shop: Shop, browser: Browser, request: pytest.FixtureRequest, with_3d: bool) -> Iterator[Page]:
    if with_3d not in shop.pages:
        shop.pages[with_3d] = _new_page(browser, shop.live.url)
        if not with_3d:
            shop.pages[with_3d].add_init_script(NO_WEBGL)
    page = shop.pages[with_3d]
    yield page
    errors = _look_back([page], request.node)
    if errors or request.node.stash.get(outcome_key, False):
        shop.pages.pop(with_3d).context.close()
    else:
        _tidy(page)
    assert not errors, f"the page raised {errors}; a screenshot is in {SCREENSHOTS}"


def _tidy(page: Page) -> None:
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


def _look_back(pages: list[Page], test: pytest.Item) -> list[str]:
    """Errors that pages raised; screenshots where there are any, or the test failed."""
    errors = [error for page in pages for error in page.errors]
    if errors or test.stash.get(outcome_key, False):
        _keep(pages, test.nodeid)
    return errors


def _keep(pages: list[Page], test: str) -> None:
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    name = re.sub(r"[^\w.-]+", "_", test)
    for number, page in enumerate(pages):
        stem = SCREENSHOTS / f"{name}.{number}"
        try:
            page.screenshot(path=stem.with_suffix(f"{stem.suffix}.png"))
        except (
            Exception
        ) as error:  # a page that crashed or was closed has no picture, but what it said is worth keeping
            page.said.append(f"no screenshot: {error}")
        stem.with_suffix(f"{stem.suffix}.txt").write_text("\n".join([page.url, *page.errors, *page.said]) + "\n")
