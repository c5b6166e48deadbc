"""The start page in a real browser: projects are created; recordings, rigs and bags are added and located; errors."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from bag_writer import START_NS, BagWriter, write_camera, write_mount, write_scan
from browser_page import drag, label_truth
from room_api import label_object

from annotator.project import Project, WriteContext, create_project
from annotator.recordings import open_recording
from annotator.recordings.recording import stored_options
from annotator.types import Source

if TYPE_CHECKING:
    from conftest import Shop
    from live_server import Live
    from playwright.sync_api import Page, Route


expect = pytest.importorskip("playwright.sync_api").expect


def test_a_new_project_can_be_created_filled_and_opened(
    start: Page, shop: Shop, room: Project, generated: Path
) -> None:
    live = shop.live
    shop.projects.append("crowd")
    start.get_by_test_id("new-project").first.click()
    start.get_by_test_id("project-name").fill(room.path.name)
    start.get_by_test_id("project-classes").fill("human, cup ,")
    start.keyboard.press("Enter")
    problem = start.get_by_test_id("new-project-dialog").get_by_role("alert")
    expect(problem).to_contain_text(room.path.name)
    start.get_by_test_id("project-name").fill("crowd")
    start.get_by_test_id("rotation-free").check()
    start.get_by_test_id("dialog-create").click()
    dialog = start.get_by_test_id("add-recording-dialog")
    dialog.get_by_test_id("folder-path").fill(str(generated))
    start.keyboard.press("Enter")
    dialog.get_by_test_id("folder-people").click()  # the recording's folder can be opened
    crumbs = dialog.get_by_label("Folder", exact=True)
    expect(crumbs).to_contain_text("people")
    crumbs.get_by_role("button").nth(1).click()
    # its boxes are imported in the background
    dialog.get_by_test_id("add-people").click()
    expect(dialog.get_by_test_id("added-recording")).to_have_text("people: 5 frames")
    said = dialog.get_by_test_id("job-import-text")
    expect(said).to_contain_text("Left out: the boxes of person, which the project does not have as classes.")
    dialog.get_by_test_id("choose-classes").click()
    start.get_by_test_id("boxes-class-person").select_option("human")
    start.get_by_test_id("dialog-import").click()
    expect(said).to_have_text("imported as labels: 15 human in 5 frames")
    start.get_by_test_id("dialog-done").click()
    card = start.get_by_test_id("project-crowd")
    expect(card).to_contain_text("1 recording, 5 of 5 frames done")
    expect(card).to_contain_text("15 accepted")
    expect(card.get_by_test_id("job-import")).to_be_hidden()
    project = live.context.project("crowd")
    assert project.config.classes == ("human", "cup")
    assert project.config.settings.rotation == "free"
    start.get_by_test_id("open-crowd").click()
    expect(start.get_by_test_id("frame-position")).to_have_text("1 / 5")

    def background() -> str:
        return start.evaluate("() => getComputedStyle(document.body).backgroundColor")

    light = background()
    start.get_by_test_id("theme").click()
    dark = background()
    assert dark != light
    start.reload()
    expect(start.get_by_test_id("operator")).to_have_text("Grace")
    assert background() == dark


def test_frames_that_cannot_be_read_are_left_out_and_a_moved_recording_is_located(
    room: Project, start: Page, tmp_path: Path, generated: Path
) -> None:
    """The server's answers about broken frames are those of `test_folders_projects.py`."""
    asked: list[dict[str, object]] = []
    name = room.path.name

    def answer(route: Route) -> None:
        asked.append(route.request.post_data_json)
        out = len(asked) - 1
        info = {"id": 1, "name": "people", "format": "rgbd_folder", "frames": 5, "missing": False, "rig_id": 1}
        added = {"recording": info, "is_new": not out, "new_frames": 0, "notes": []}
        added |= {"broken": ["1 of 5 frames cannot be read", "1 frame (000001): empty"], "left_out": out}
        route.fulfill(json={"added": [added | {"can_leave_out": not out}], "job": None, "note": None})

    start.route(f"**/api/projects/{name}/recordings", answer)
    start.get_by_test_id(f"add-recording-{name}").click()
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
    start.get_by_test_id("dialog-done").click()
    start.unroute(f"**/api/projects/{name}/recordings")

    there = tmp_path / "was here" / "people"
    keys = [frame.key for frame in room.frames.of()]

    def lose() -> None:
        shutil.copytree(generated / "people", there)
        room.recordings.move({1: (there, keys)})
        shutil.rmtree(there)
        start.reload()

    lose()
    start.get_by_test_id(f"add-recording-{name}").click()
    start.get_by_test_id(f"folder-{generated.name}").click()
    start.get_by_test_id("add-people").click()
    offer = "people has the frames of the recording people, whose folder was not found"
    expect(start.get_by_test_id("moved")).to_contain_text(offer)
    expect(start.get_by_test_id("added-recording")).to_have_count(0)
    start.get_by_test_id("use-new-path").click()
    expect(start.get_by_test_id("add-as-new")).to_have_count(0)
    expect(start.get_by_test_id("added-recording")).to_contain_text("people is now at")
    start.get_by_test_id("dialog-done").click()
    assert room.recordings.get(1).path == generated / "people"

    lose()
    start.get_by_test_id("locate-people").click()
    dialog = start.get_by_test_id("locate-dialog")
    dialog.get_by_test_id("dialog-locate").click()
    expect(dialog.get_by_role("alert")).to_have_text("Please choose a folder first.")
    dialog.get_by_test_id(f"folder-{generated.name}").click()
    dialog.get_by_test_id("choose-people").click()
    dialog.get_by_test_id("dialog-locate").click()
    expect(dialog).to_have_count(0)
    expect(start.get_by_test_id("locate-people")).to_have_count(0)
    assert room.recordings.get(1).path == generated / "people"


def test_a_sample_is_made_by_one_click_and_guided(
    start: Page, shop: Shop, generated: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("annotator.workflows.sample.FRAMES", 2)
    shop.projects.append("sample")
    start.get_by_test_id("sample-project").click()
    guide = start.get_by_test_id("guide")
    now = guide.locator("[aria-current=step]")
    expect(now).to_have_text(["Drag a box around a person on the image", "Space takes the dashed box"])
    project = shop.live.context.project("sample")
    label_truth(project, project.recordings.get(1).path, 1)
    expect(now).to_have_text(["Export the boxes"])
    now.get_by_role("link").click()
    expect(start.get_by_test_id("export-start")).to_be_enabled()
    start.get_by_test_id("guide-end").click()
    expect(guide).to_be_hidden()
    start.get_by_test_id("home").click()
    card = start.get_by_test_id("project-sample")
    expect(card).to_contain_text("1 of 2 frames done")
    expect(card.get_by_test_id("next-sample")).to_have_text("Go on with the next frame")


def test_recordings_and_projects_are_managed_from_a_menu(room: Project, start: Page, shop: Shop) -> None:
    get, name = start.get_by_test_id, room.path.name
    shop.projects += ["hall", "hall-copy"]
    label_truth(room, shop.recording, 1)

    def choose(entry: str, project: str) -> None:
        get(f"menu-{project}").click()
        get(f"{entry}-{project}").click()

    choose("recordings", name)
    expect(get("recording-people")).to_contain_text("5 frames, 3 labels")
    get("remove").click()
    get("dialog-yes").click()
    expect(get("recording-people")).to_contain_text("removed by Grace")
    get("restore").click()
    expect(get("recording-people")).to_contain_text("5 frames, 3 labels")
    get("dialog-done").click()

    choose("rename", name)
    get("new-name").fill("not valid")
    get("dialog-rename").click()
    expect(get("rename-dialog").get_by_role("alert")).to_contain_text("is not a valid project name")
    get("new-name").fill("hall")
    get("dialog-rename").click()
    expect(get("project-hall")).to_contain_text("3 accepted")

    choose("copy", "hall")
    get("copy-labels").uncheck()
    get("dialog-copy").click()
    expect(get("project-hall")).to_contain_text("copied to hall-copy, without labels")
    expect(get("project-hall-copy")).to_contain_text("no boxes yet")

    choose("remove", "hall")
    get("dialog-cancel").click()
    choose("remove", "hall")
    expect(start.get_by_role("dialog", name="Remove hall")).to_contain_text("1 recording and 3 labels")
    get("dialog-yes").click()
    expect(get("project-hall")).to_have_count(0)
    get("removed").locator("summary").click()
    get("bring-back-hall").click()
    expect(get("project-hall")).to_contain_text("3 accepted")
    choose("remove", "hall-copy")
    get("dialog-yes").click()
    expect(get("project-hall-copy")).to_have_count(0)


def test_open_pages_follow_a_project_that_is_renamed_removed_missing_or_not_answered(
    room: Project, start: Page, live: Live, shop: Shop
) -> None:
    page, position, offline = start, start.get_by_test_id("frame-position"), start.locator(".offline")
    problem = page.get_by_test_id("page-problem")
    shop.projects += ["palace", "later"]
    page.goto(f"/#/{room.path.name}/annotate/2")
    expect(position).to_have_text("2 / 5")
    live.client.post(f"/api/projects/{room.path.name}/rename", json={"name": "palace"})
    expect(page.get_by_test_id("toast-info")).to_contain_text("Ada has renamed this project to palace.")
    expect(page).to_have_url(f"{live.url}/#/palace/annotate/2")
    page.get_by_test_id("image-editor").locator("img.picture[src*='/palace/']").wait_for()
    page.keyboard.press("n")
    expect(position).not_to_have_text("2 / 5")

    # a page that could not be opened is opened once the server is back
    asked = "**/api/projects/palace"
    page.goto("/#/")
    page.get_by_test_id("new-project").first.wait_for()
    page.route(asked, lambda route: route.abort())
    page.goto("/#/palace/statistics")
    expect(problem).to_contain_text("The server does not respond")
    page.unroute(asked)
    live.context.hub.close()  # ends all connections; the page connects again
    expect(page.get_by_test_id("statistics")).to_be_visible()

    page.goto("/#/palace/annotate/2")
    expect(position).to_have_text("2 / 5")
    live.client.delete("/api/projects/palace/recordings/1")
    expect(page.get_by_test_id("toast-warn")).to_contain_text("Ada has removed this recording from the project.")
    expect(page.get_by_text("palace has no recording yet")).to_be_visible()
    live.client.delete("/api/projects/palace")
    expect(page.get_by_test_id("toast-warn").last).to_contain_text("Ada has removed this project.")
    expect(page.get_by_test_id("new-project").first).to_be_visible()

    # a missing project, which is created meanwhile; no lost connection is reported
    page.goto("/#/later")
    expect(problem).to_be_visible()
    expect(offline).to_be_empty()
    create_project(live.settings.projects_root, "later", ("hand",)).close()
    page.evaluate("dispatchEvent(new Event('focus'))")  # back from the terminal
    expect(problem).to_be_hidden()
    expect(page.get_by_test_id("mode-annotate")).to_be_visible()

    # the note of a lost connection does not stay on the start page
    lost = [True]  # such a route stays on the shared page
    page.route_web_socket("**/api/events**", lambda it: it.close() if lost else it.connect_to_server())
    page.goto("/#/later/statistics")
    page.reload()
    expect(offline).to_contain_text("no connection")
    lost.clear()
    page.get_by_test_id("home").click()
    expect(page.get_by_test_id("new-project").first).to_be_visible()
    expect(offline).to_be_empty()


def test_virtual_cameras_share_a_label_and_topics_of_a_bag_are_chosen_with_a_preview(
    start: Page, shop: Shop, tmp_path: Path
) -> None:
    create_project(shop.live.settings.projects_root, "rig", ("car",)).close()
    shop.projects.append("rig")
    start.reload()
    start.get_by_test_id("add-recording-rig").click()
    start.get_by_test_id("folder-clouds").click()
    start.get_by_test_id("add-drive").click()
    added = start.get_by_test_id("added-recording")
    expect(added).to_have_text(["drive: 1 frame"])
    # another choice makes the button usable again
    start.get_by_test_id("which-cameras").select_option(label="4 virtual cameras all around the LiDAR")
    start.get_by_test_id("add-drive").click()
    expect(added.nth(4)).to_have_text("drive@around-270: 1 frame")
    start.get_by_test_id("dialog-done").click()
    project, tag = shop.live.context.project("rig"), start.get_by_test_id("editor-tag")
    uid = label_object(project, 2, -10.0)
    start.goto("/#/rig/annotate/3")
    expect(tag).to_have_text(["car #3 · accepted"])
    # what changes in the other camera is shown at once
    project.labels.delete(2, uid, WriteContext(project.frames.get(2).revision, "maria", Source.MANUAL))
    expect(tag).to_have_count(0)
    uid = label_object(project, 2, -10.0)
    expect(tag).to_have_count(1)
    # all cameras of the moment are beside the image, and the selected box stays selected in each
    selected = start.locator('[data-testid="frame-box"][aria-current="true"]')
    start.get_by_test_id("frame-box").click()
    expect(selected).to_have_attribute("data-uid", uid)
    cameras = start.get_by_test_id("camera-strip").get_by_role("button")
    expect(cameras).to_have_count(4)
    cameras.first.click()
    expect(start).to_have_url(re.compile("/annotate/2$"))
    expect(selected).to_have_attribute("data-uid", uid)
    expect(cameras.first).to_have_attribute("aria-current", "true")
    # from a camera that does not see it, a double click and a key lead to the one that sees it best
    for go in (lambda: start.get_by_test_id("frame-box").dblclick(), lambda: start.keyboard.press("k")):
        cameras.last.click()
        expect(start).to_have_url(re.compile("/annotate/5$"))
        expect(start.get_by_test_id("image-note")).to_contain_text("double click")
        go()
        expect(start).to_have_url(re.compile("/annotate/[23]$"))
        expect(selected).to_have_attribute("data-uid", uid)
    # the places have the sizes that they were given, and the next area has the main one
    border = start.get_by_test_id("border-first")
    width_of = "(selector) => document.querySelector(selector).getBoundingClientRect().width"
    width = start.evaluate(width_of, "section.image")
    place = border.evaluate("(one) => one.getBoundingClientRect().toJSON()")
    drag(start, (place["x"] + 4, place["y"] + 9), (place["x"] - 56, place["y"] + 9))
    assert start.evaluate(width_of, "section.image") == pytest.approx(width - 60, abs=1)
    border.dblclick()
    assert start.evaluate(width_of, "section.image") == width
    start.keyboard.press("q")
    start.reload()
    start.get_by_test_id("frame-box").wait_for()
    assert start.evaluate(width_of, "section.scene:not([hidden])") == width
    start.keyboard.press("q")
    start.keyboard.press("q")
    assert start.evaluate(width_of, "section.image") == width
    start.goto("/#/rig/alignment/3")
    expect(start.get_by_test_id("correction-effect")).to_contain_text("no calibration to correct")
    expect(start.get_by_test_id("keep-correction")).to_be_hidden()
    expect(start.get_by_test_id("estimate-up")).to_be_visible()

    # a bag with two cameras
    start.get_by_test_id("home").click()
    live, root = shop.live, shop.folder
    (tmp_path / "left and right").mkdir()
    with BagWriter(tmp_path / "left and right", "ros1") as bag:
        write_mount(bag)
        write_scan(bag, START_NS)
        for name in ("left", "right"):
            write_camera(bag, name, START_NS)
    shutil.copy(bag.path, root / "two_cameras.bag")
    live.client.post("/api/projects", json={"name": "drive", "classes": ["car"]})
    shop.projects.append("drive")
    start.reload()
    start.get_by_test_id("add-recording-drive").click()
    start.get_by_test_id(f"folder-{root.name}").click()
    start.get_by_test_id("add-two_cameras.bag").click()
    dialog = start.get_by_test_id("topics-dialog")
    expect(dialog.get_by_test_id("topics-problem")).to_contain_text("choose one of its topics with Images")
    dialog.get_by_test_id("dialog-add").click()
    expect(dialog).to_contain_text("Please choose topics that can be read first.")
    dialog.get_by_test_id("topic-image").select_option("/right/image_raw")
    picture = dialog.get_by_test_id("topics-preview")
    expect(picture).to_be_visible()
    assert picture.evaluate("image => image.naturalWidth") == 32
    expect(dialog.get_by_test_id("topic-points")).to_contain_text("/points (chosen automatically)")
    expect(dialog.get_by_test_id("topic-camera_info")).to_contain_text("/right/camera_info (chosen automatically)")
    expect(dialog.get_by_test_id("topic-depth_info")).to_be_hidden()
    dialog.get_by_test_id("dialog-add").click()
    expect(start.get_by_test_id("added-recording")).to_have_text("two_cameras: 1 frame")
    (stored,) = live.context.project("drive").recordings.all()
    assert stored.options == '{"image":"/right/image_raw"}'
    assert len(open_recording(stored.path, stored_options(stored.options))) == 1

    (root / "two_cameras.bag").unlink()
