"""The start page in a real browser: creating projects, adding and locating recordings, and errors."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from room_api import BOX, change, state

from annotator.project import create_project

expect = pytest.importorskip("playwright.sync_api").expect

if TYPE_CHECKING:
    from live_server import Live
    from playwright.sync_api import Page, Route


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


def test_frames_that_cannot_be_read_are_told_and_left_out(start: Page, live: Live, generated: Path) -> None:
    """The server's answers are those of `test_folders_projects.py`."""
    asked: list[dict[str, object]] = []

    def answer(route: Route) -> None:
        asked.append(route.request.post_data_json)
        out = len(asked) - 1
        info = {"id": 1, "name": "people", "format": "rgbd_folder", "frames": 5, "is_sequence": True, "missing": False}
        added = {"recording": info, "is_new": not out, "new_frames": 0, "missing_frames": 0, "notes": []}
        added |= {"broken": ["1 of 5 frames cannot be read", "1 frame (000001): empty"], "left_out": out}
        route.fulfill(json={"added": [added | {"can_leave_out": not out}], "job": None, "note": None})

    start.route("**/api/projects/room/recordings", answer)
    start.get_by_test_id("add-recording-room").click()
    start.get_by_test_id(f"folder-{generated.name}").click()
    dialog = start.get_by_test_id("add-recording-dialog")
    dialog.get_by_test_id("add-people").click()
    expect(dialog.get_by_test_id("broken-frames")).to_have_text(
        ["1 of 5 frames cannot be read", "1 frame (000001): empty"]
    )
    dialog.get_by_test_id("leave-out-broken").click()
    told = "people was already in the project: 0 new frames, 1 left out"
    expect(dialog.get_by_test_id("added-recording").last).to_have_text(told)
    expect(dialog.get_by_test_id("leave-out-broken")).to_have_count(0)
    first, again = asked
    assert (first["labels"], again["labels"], again["leave_out_broken"]) == (True, False, True)
    assert first["options"] == again["options"]


def test_a_moved_recording_can_be_located(start: Page, live: Live, tmp_path: Path, generated: Path) -> None:
    there = tmp_path / "was here" / "people"
    shutil.copytree(generated / "people", there)
    project = live.context.project("room")
    project.recordings.move(1, there, [frame.key for frame in project.frames.of()], "Ada")
    shutil.rmtree(there)
    start.reload()
    start.get_by_test_id("add-recording-room").click()
    start.get_by_test_id(f"folder-{generated.name}").click()
    start.get_by_test_id("add-people").click()
    offer = start.get_by_test_id("moved-dialog")
    expect(offer).to_contain_text("people has the frames of the recording people, whose folder was not found")
    offer.get_by_test_id("dialog-cancel").click()
    expect(start.get_by_test_id("added-recording")).to_have_count(0)
    start.get_by_test_id("add-people").click()
    offer.get_by_test_id("dialog-moved").click()
    expect(start.get_by_test_id("added-recording")).to_contain_text("people is now at")
    start.get_by_test_id("dialog-done").click()
    assert project.recordings.get(1).path == generated / "people"

    shutil.copytree(generated / "people", there)
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


def test_recordings_and_projects_are_managed_from_a_menu(start: Page, live: Live) -> None:
    get = start.get_by_test_id

    def choose(entry: str, project: str) -> None:
        get(f"menu-{project}").click()
        get(f"{entry}-{project}").click()

    label(live)
    choose("recordings", "room")
    expect(get("recording-people")).to_contain_text("5 frames, 1 label")
    get("remove").click()
    get("dialog-yes").click()
    expect(get("recording-people")).to_contain_text("removed by Grace")
    get("restore").click()
    expect(get("recording-people")).to_contain_text("5 frames, 1 label")
    get("dialog-done").click()

    choose("rename", "room")
    get("new-name").fill("not valid")
    get("dialog-rename").click()
    expect(get("rename-dialog").get_by_role("alert")).to_contain_text("is not a valid project name")
    get("new-name").fill("hall")
    get("dialog-rename").click()
    expect(get("project-hall")).to_contain_text("1 accepted")

    choose("copy", "hall")
    get("copy-labels").uncheck()
    get("dialog-copy").click()
    expect(get("project-hall")).to_contain_text("copied to hall-copy, without labels")
    expect(get("project-hall-copy")).to_contain_text("no labels")

    choose("remove", "hall")
    get("dialog-cancel").click()
    choose("remove", "hall")
    get("new-name").fill("hal")
    get("dialog-remove").click()
    expect(get("remove-dialog").get_by_role("alert")).to_have_text("Please type the name of the project: hall")
    get("new-name").fill("hall")
    get("dialog-remove").click()
    expect(get("removed-dialog")).to_contain_text("annotator project copy projects/.removed/hall-")
    get("dialog-close").click()
    choose("remove", "hall-copy")  # without labels, no name has to be typed
    expect(get("new-name")).to_have_count(0)
    get("dialog-remove").click()
    get("dialog-close").click()
    expect(get("no-projects")).to_be_visible()


def label(live: Live) -> None:
    """Ada labels an object in the first frame of `room`."""
    revision = state(live.client)["frame"]["revision"]
    assert change(live.client, revision, {"kind": "create", "label": "person", "box": BOX}).status_code == 200


def test_open_pages_follow_a_renamed_project_and_leave_what_is_removed(start: Page, live: Live) -> None:
    room, position = "/api/projects/room", start.get_by_test_id("frame-position")
    label(live)
    start.goto("/#/room/label/2")
    expect(position).to_have_text("2 / 5")
    live.client.post(f"{room}/rename", json={"name": "hall"})
    expect(start.get_by_test_id("toast-info")).to_contain_text("Ada has renamed this project to hall.")
    expect(start).to_have_url(f"{live.url}/#/hall/label/2")
    start.get_by_test_id("next-frame").click()
    expect(position).not_to_have_text("2 / 5")
    live.client.delete("/api/projects/hall/recordings/1")
    expect(start.get_by_test_id("toast-warn")).to_contain_text("Ada has removed this recording from the project.")
    expect(start.get_by_text("hall has no recording yet")).to_be_visible()
    live.client.delete("/api/projects/hall")
    expect(start.get_by_test_id("toast-warn").last).to_contain_text("Ada has removed this project.")
    expect(start.get_by_test_id("no-projects")).to_be_visible()


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
