"""Review in a real browser: navigation, finalising, changes of other operators, and unreadable frames."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from review_desk import Desk

from annotator.project import Project
from annotator.types.errors import FrameError

expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect


def test_keys_change_the_frame_and_finalise_it(desk: Desk, wait_for) -> None:
    frames = [stored.id for stored in desk.project.frames.of()]
    desk.page.goto(f"/#/{desk.name}/review/{frames[0]}")
    expect(desk.page.get_by_test_id("frame-position")).to_have_text("1 / 5")
    desk.press("n")
    expect(desk.page.get_by_test_id("frame-position")).to_have_text("2 / 5")
    assert desk.frame == frames[1]
    expect(desk.page.get_by_test_id("act-copy")).to_be_enabled()
    desk.press("Control+Enter")
    desk.page.get_by_test_id("dialog-yes").click()
    wait_for(lambda: desk.project.frames.get(frames[1]).finalised)
    expect(desk.page.get_by_test_id("act-finalise")).to_have_text("Reopen frame")
    expect(desk.page.get_by_test_id("act-copy")).to_be_disabled()
    desk.page.get_by_test_id("act-finalise").click()
    wait_for(lambda: not desk.project.frames.get(frames[1]).finalised)
    expect(desk.page.get_by_test_id("act-copy")).to_be_enabled()
    desk.press("p")
    expect(desk.page.get_by_test_id("frame-position")).to_have_text("1 / 5")


def test_of_two_requested_frames_the_last_one_is_opened(desk: Desk) -> None:
    frames = [stored.id for stored in desk.project.frames.of()]
    desk.page.goto(f"/#/{desk.name}/review/{frames[0]}")
    expect(desk.page.get_by_test_id("frame-position")).to_have_text("1 / 5")
    later = desk.project.labels.of_frame(frames[2])[0]
    desk.page.route(f"**/frames/{frames[2]}", lambda route: None)
    with desk.page.expect_request(f"**/frames/{frames[2]}"):
        desk.page.locator(f'[data-testid="queue-item"][data-uid="{later.uid}"]').click()
    desk.press("n")
    expect(desk.page.get_by_test_id("frame-position")).to_have_text("2 / 5")
    desk.settled()
    assert desk.frame == frames[1]


def test_another_operators_change_appears_at_once(desk: Desk) -> None:
    frame, uid = desk.frame, desk.uid
    revision = desk.project.frames.get(frame).revision
    body = {"revision": revision, "changes": [{"kind": "reject", "uid": uid}], "effort": None, "subject": None}
    answer = desk.live.client.post(f"{desk.api}/frames/{frame}/changes", json=body)
    assert answer.status_code == 200
    row = desk.page.locator(f'[data-testid="frame-box"][data-uid="{uid}"][data-state="rejected"]')
    row.wait_for()


def test_an_unreadable_frame_shows_its_error_instead_of_its_image(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    page, frames = desk.page, desk.live.context.caches.frames
    page.evaluate("localStorage.setItem('label-order', 'time')")
    first, second, third = (stored.id for stored in desk.project.frames.of()[:3])
    truncated = FrameError(Path("people/depth/000001.png"), "the file is truncated", "copy it again")
    read = frames.open

    def broken(project: Project, frame_id: int, who: str = "") -> Any:
        if frame_id == second:
            raise truncated
        return read(project, frame_id, who)

    monkeypatch.setattr(frames, "open", broken)
    problem = page.get_by_test_id("frame-problem")
    for mode, picture in (("review", "review-image"), ("label", "image-editor")):
        page.goto(f"/#/{desk.name}/{mode}/{first}")
        shown = page.get_by_test_id(picture).locator("img.picture")
        expect(shown).to_have_attribute("src", re.compile(f"/frames/{first}/"))
        page.get_by_role("button", name="Next frame in time").click()
        expect(problem).to_contain_text("the file is truncated")
        expect(problem).to_contain_text("copy it again")
        expect(shown).to_be_hidden()
        expect(page.locator('[data-testid="frame-box"], [data-testid="object"]')).to_have_count(0)
        expect(page).to_have_url(re.compile(f"/{mode}/{second}$"))
        page.get_by_test_id("frame-next").click()
        expect(page).to_have_url(re.compile(f"/{mode}/{third}$"))
        expect(problem).to_be_hidden()
        page.get_by_role("button", name="Previous frame in time").click()
        expect(problem).to_be_visible()
        monkeypatch.setattr(frames, "open", read)
        page.get_by_test_id("frame-retry").click()
        expect(shown).to_have_attribute("src", re.compile(f"/frames/{second}/"))
        expect(problem).to_be_hidden()
        monkeypatch.setattr(frames, "open", broken)
