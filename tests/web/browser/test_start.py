"""The start page in a real browser: from nothing to the first frame, with what a new operator sees on the way."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest

expect = pytest.importorskip("playwright.sync_api").expect

if TYPE_CHECKING:
    from live_server import Live
    from playwright.sync_api import Page

NO_WEBGL = "HTMLCanvasElement.prototype.getContext = () => null"


@pytest.fixture
def start(open_page: Callable[..., Page]) -> Page:
    """The start page, signed in through its dialog."""
    page = open_page()
    page.add_init_script(NO_WEBGL)
    page.goto("/")
    page.get_by_test_id("operator-name").fill("Grace")
    page.keyboard.press("Enter")
    expect(page.get_by_test_id("operator")).to_have_text("Grace")
    return page


def test_a_new_project_gets_a_recording_and_opens(start: Page, live: Live) -> None:
    expect(start.get_by_test_id("project-room")).to_contain_text("1 recording, 5 frames")
    start.get_by_test_id("new-project").click()
    start.get_by_test_id("project-name").fill("hands")
    start.get_by_test_id("project-classes").fill("hand, cup ,")
    start.get_by_test_id("rotation-free").check()
    start.get_by_test_id("dialog-create").click()
    start.get_by_test_id(f"folder-{live.settings.folders[0].name}").click()
    start.get_by_test_id("add-hands").click()
    expect(start.get_by_test_id("added-recording")).to_contain_text("5 frames", timeout=15_000)
    start.get_by_test_id("dialog-done").click()
    expect(start.get_by_test_id("project-hands")).to_contain_text("1 recording, 5 frames")
    project = live.context.project("hands")
    assert project.config.classes == ("hand", "cup")
    assert project.config.settings.rotation == "free"
    start.get_by_test_id("open-hands").click()
    expect(start.get_by_test_id("frame-position")).to_have_text("1 / 5", timeout=15_000)


def test_a_name_that_cannot_be_is_told_in_the_dialog(start: Page) -> None:
    start.get_by_test_id("new-project").click()
    start.get_by_test_id("project-name").fill("room")
    start.get_by_test_id("project-classes").fill("person")
    start.keyboard.press("Enter")
    problem = start.get_by_test_id("new-project-dialog").get_by_role("alert")
    expect(problem).to_contain_text("room")
    expect(start.get_by_test_id("dialog-create")).to_be_enabled()


def test_a_project_that_is_not_there_says_so(start: Page) -> None:
    start.goto("/#/nowhere/label/1")
    expect(start.get_by_test_id("page-problem")).to_be_visible()
    start.get_by_role("link", name="All projects").last.click()
    expect(start.get_by_test_id("project-room")).to_be_visible()


def test_the_theme_is_switched_and_kept(start: Page) -> None:
    def background() -> str:
        return start.evaluate("() => getComputedStyle(document.body).backgroundColor")

    light = background()
    start.get_by_test_id("theme").click()
    dark = background()
    assert dark != light
    start.reload()
    expect(start.get_by_test_id("operator")).to_have_text("Grace")
    assert background() == dark
