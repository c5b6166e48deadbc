"""Where one is, in a real browser: the timeline, and the recording, frame and camera in the top bar."""

from __future__ import annotations

import re

import pytest
from browser_page import Desk, drag

from annotator.project import WriteContext
from annotator.project.changes import LabelChanged
from annotator.types import ReviewState

expect = pytest.importorskip("playwright.sync_api").expect


def test_one_goes_anywhere_from_the_timeline_and_the_top_bar(desk: Desk) -> None:
    page, project = desk.page, desk.project
    frames = project.frames.of()
    uids = [next(label.uid for label in project.labels.of_frame(stored.id)) for stored in (frames[0], frames[2])]
    for stored, uid in zip((frames[0], frames[2]), uids, strict=True):
        change = LabelChanged(uid=uid, track_id=7, state=ReviewState.ACCEPTED)
        project.log.append(stored.id, [change], WriteContext(stored.revision, "Ada"))
    lanes = page.get_by_test_id("timeline-lanes").locator("canvas")
    page.goto(f"/#/{desk.name}/review/{frames[1].id}")
    position = page.get_by_test_id("frame-position")
    expect(position).to_have_text("2 / 5")

    # every frame has its small picture, and one of them is that of the open frame
    pictures = page.get_by_test_id("timeline-strip").get_by_role("button")
    for number, stored in enumerate(frames):
        expect(pictures.nth(number)).to_have_attribute("style", re.compile(rf"/frames/{stored.id}/image\.jpg"))
    pictures.nth(3).click()
    expect(position).to_have_text("4 / 5")
    expect(pictures.nth(3)).to_have_attribute("aria-current", "true")

    # a click on a lane opens the frame there, and selects the track's box
    expect(lanes).to_have_attribute("aria-label", re.compile("^1 track"))
    shown = lanes.bounding_box()
    names = page.get_by_test_id("timeline-strip").bounding_box()
    assert shown is not None and names is not None

    def at(place: int) -> tuple[float, float]:
        return names["x"] + (place + 0.5) * names["width"] / 5, shown["y"] + 7

    page.mouse.click(*at(2))
    expect(position).to_have_text("3 / 5")
    page.locator(f'[data-testid="frame-box"][aria-current="true"][data-uid="{uids[1]}"]').wait_for()
    expect(lanes).to_have_attribute("aria-label", "1 track; person 7: in 2 frames, 2 reviewed")
    expect(page).to_have_url(re.compile(r"track=7$"))
    # a name leads to the nearest box
    page.mouse.click(shown["x"] + 40, shown["y"] + 7)
    desk.settled()
    expect(position).to_have_text("3 / 5")
    # a drag selects a part of the track
    drag(page, at(0), at(1), at(2))
    expect(lanes).to_have_attribute("aria-label", re.compile("frames 1 to 3 selected$"))
    desk.press("Escape")
    expect(lanes).to_have_attribute("aria-label", re.compile("2 reviewed$"))
    # another operator's change is shown
    project.labels.delete(frames[0].id, uids[0], WriteContext(project.frames.get(frames[0].id).revision, "Ada"))
    expect(lanes).to_have_attribute("aria-label", "1 track; person 7: in 1 frame, 1 reviewed")

    # the slider, the number of a frame; a number that is none means the nearest frame
    page.get_by_test_id("timeline-slider").press("ArrowLeft")
    expect(position).to_have_text("2 / 5")
    for typed, found in (("1", "1 / 5"), ("99", "5 / 5")):
        desk.press("Control+g")
        page.keyboard.type(typed)
        desk.press("Enter")
        expect(position).to_have_text(found)
    desk.press("l")
    expect(lanes).to_be_hidden()
    page.reload()
    expect(page.get_by_test_id("timeline-fold")).to_have_attribute("aria-expanded", "false")
    expect(position).to_have_text("5 / 5")
    desk.press("l")
    expect(lanes).to_be_visible()

    # another recording, which has several cameras
    body = {"path": "clouds/drive", "options": {"look_around": 4, "camera": "all"}}
    assert desk.live.client.post(f"{desk.api}/recordings", json=body).status_code == 200
    page.get_by_test_id("choose-recordings").click()
    choices = page.get_by_test_id("recordings").get_by_role("button")
    expect(choices).to_have_count(2)
    expect(choices.first).to_contain_text("5 frames · 1 of ")
    page.keyboard.type("DRI")
    expect(choices).to_have_count(1)
    desk.press("Enter")
    expect(page.get_by_test_id("recording-name")).to_have_text("drive")
    expect(position).to_have_text("1 / 1")
    camera = page.get_by_test_id("choose-cameras")
    # the page hears of the cameras one after another
    expect(camera).to_contain_text("around-0001 of 4")
    desk.press("Shift+K")
    expect(camera).to_contain_text("around-270")
    camera.click()
    page.get_by_test_id("cameras").get_by_text("around-090").click()
    expect(camera).to_contain_text("2 of 4")
