"""The start page in a real browser: creating projects, adding and locating recordings, and errors."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from annotator.project import create_project

expect = pytest.importorskip("playwright.sync_api").expect

if TYPE_CHECKING:
    from live_server import Live
    from playwright.sync_api import Page


def test_a_new_project_can_be_created_filled_and_opened(start: Page, live: Live) -> None:
    expect(start.get_by_test_id("project-room")).to_contain_text("1 recording, 5 frames")
    start.get_by_test_id("new-project").click()
    start.get_by_test_id("project-name").fill("hands")
    start.get_by_test_id("project-classes").fill("hand, cup ,")
    start.get_by_test_id("rotation-free").check()
    start.get_by_test_id("dialog-create").click()
    start.get_by_test_id(f"folder-{live.settings.folders[0].name}").click()
    start.get_by_test_id("add-hands").click()
    expect(start.get_by_test_id("added-recording")).to_contain_text("5 frames")
    start.get_by_test_id("dialog-done").click()
    expect(start.get_by_test_id("project-hands")).to_contain_text("1 recording, 5 frames")
    project = live.context.project("hands")
    assert project.config.classes == ("hand", "cup")
    assert project.config.settings.rotation == "free"
    start.get_by_test_id("open-hands").click()
    expect(start.get_by_test_id("frame-position")).to_have_text("1 / 5")


def test_the_boxes_of_a_recording_are_imported_in_the_background(start: Page, live: Live) -> None:
    live.client.post("/api/projects", json={"name": "crowd", "classes": ["person"]})
    start.reload()
    start.get_by_test_id("add-recording-crowd").click()
    start.get_by_test_id(f"folder-{live.settings.folders[0].name}").click()
    dialog = start.get_by_test_id("add-recording-dialog")
    dialog.get_by_test_id("folder-people").click()  # the recording's folder can be opened
    crumbs = dialog.get_by_label("Folder", exact=True)
    expect(crumbs).to_contain_text("people")
    crumbs.get_by_role("button").nth(1).click()
    dialog.get_by_test_id("add-people").click()
    expect(dialog.get_by_test_id("added-recording")).to_have_text("people: 5 frames")
    expect(dialog.get_by_test_id("job-import-text")).to_have_text("15 boxes imported")
    start.get_by_test_id("dialog-done").click()
    expect(start.get_by_test_id("project-crowd")).to_contain_text("15 accepted")
    expect(start.get_by_test_id("project-crowd").get_by_test_id("job-import")).to_be_hidden()


# The delays between the requests of `imports.js` while a job runs; timers fire at once.
WAITS = """async (questions) => {
  const { followImports } = await import("/assets/js/start/imports.js");
  const waits = [];
  const job = { id: "1", kind: "import", state: "running" };
  const state = { jobs: [job], on: () => () => {}, set: (changes) => Object.assign(state, changes) };
  const answer = () => ({ jobs: waits.length < questions ? [job] : [{ ...job, state: "done" }] });
  const plain = window.setTimeout;
  window.setTimeout = (fn, ms) => (waits.push(Math.round(ms)), plain(fn, 0));
  try {
    await new Promise((resolve) => followImports({ state, api: { get: async () => answer() } }, resolve));
  } finally {
    window.setTimeout = plain;
  }
  return waits;
}"""


def test_a_long_import_is_polled_less_and_less_often(start: Page) -> None:
    waits = start.evaluate(WAITS, 9)
    assert len(waits) == 9 and waits[0] == 700
    assert waits == sorted(waits) and waits[-1] == 5000


def test_a_moved_recording_can_be_located(start: Page, live: Live, tmp_path: Path, generated: Path) -> None:
    there = tmp_path / "was here" / "people"
    shutil.copytree(generated / "people", there)
    project = live.context.project("room")
    project.recordings.move(1, there, [frame.key for frame in project.frames.of()], "Ada")
    shutil.rmtree(there)
    start.reload()
    start.get_by_test_id("locate-people").click()
    dialog = start.get_by_test_id("locate-dialog")
    dialog.get_by_test_id("dialog-locate").click()
    expect(dialog.get_by_role("alert")).to_have_text("Please choose a folder first.")
    dialog.get_by_test_id(f"folder-{generated.name}").click()
    dialog.get_by_test_id("choose-people").click()
    dialog.get_by_test_id("dialog-locate").click()
    expect(dialog).to_have_count(0)
    expect(start.get_by_test_id("locate-people")).to_have_count(0)
    assert project.recordings.get(1).path == generated / "people"


def test_the_dialog_shows_the_error_of_an_invalid_name(start: Page) -> None:
    start.get_by_test_id("new-project").click()
    start.get_by_test_id("project-name").fill("room")
    start.get_by_test_id("project-classes").fill("person")
    start.keyboard.press("Enter")
    problem = start.get_by_test_id("new-project-dialog").get_by_role("alert")
    expect(problem).to_contain_text("room")
    expect(start.get_by_test_id("dialog-create")).to_be_enabled()


def test_a_missing_project_is_reported(start: Page) -> None:
    start.goto("/#/nowhere/label/1")
    expect(start.get_by_test_id("page-problem")).to_be_visible()
    start.get_by_role("link", name="All projects").last.click()
    expect(start.get_by_test_id("project-room")).to_be_visible()


def test_a_project_that_is_created_meanwhile_is_opened_and_no_lost_connection_is_reported(
    start: Page, live: Live
) -> None:
    page, offline = start, start.locator(".offline")
    page.goto("/#/later")
    expect(page.get_by_test_id("page-problem")).to_be_visible()
    expect(offline).to_be_empty()
    create_project(live.settings.projects_root, "later", ("hand",)).close()
    page.evaluate("dispatchEvent(new Event('focus'))")  # back from the terminal
    expect(page.get_by_test_id("page-problem")).to_be_hidden()
    expect(page.get_by_test_id("mode-label")).to_be_visible()
    expect(offline).to_be_empty()


def test_a_page_that_could_not_be_opened_is_opened_once_the_server_is_back(start: Page, live: Live) -> None:
    page, asked = start, "**/api/projects/room"
    page.route(asked, lambda route: route.abort())
    page.goto("/#/room/statistics")
    expect(page.get_by_test_id("page-problem")).to_contain_text("The server does not respond")
    page.unroute(asked)
    live.context.hub.close()  # ends all connections; the page connects again
    expect(page.get_by_test_id("statistics")).to_be_visible()


def test_the_note_of_a_lost_connection_does_not_stay_on_the_start_page(start: Page, live: Live) -> None:
    page, offline = start, start.locator(".offline")
    page.route_web_socket("**/api/events**", lambda socket: socket.close())
    page.goto("/#/room/statistics")
    expect(offline).to_contain_text("no connection")
    page.get_by_test_id("home").click()
    expect(page.get_by_test_id("new-project").first).to_be_visible()
    expect(offline).to_be_empty()


def test_the_theme_can_be_switched_and_survives_a_reload(start: Page) -> None:
    def background() -> str:
        return start.evaluate("() => getComputedStyle(document.body).backgroundColor")

    light = background()
    start.get_by_test_id("theme").click()
    dark = background()
    assert dark != light
    start.reload()
    expect(start.get_by_test_id("operator")).to_have_text("Grace")
    assert background() == dark
