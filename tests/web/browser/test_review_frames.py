"""Review in a real browser: going through frames, unreadable ones; stale and failed edits are not lost."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser_page import Desk, refuse

from annotator.project import Project, WriteContext
from annotator.types import ReviewState
from annotator.types.errors import FrameError

expect = pytest.importorskip("playwright.sync_api").expect


def test_frames_are_changed_finalised_and_shown_with_their_problem(
    desk: Desk, wait_for, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    desk.press("n")
    desk.settled()
    # another operator's change appears at once
    uid = desk.uid
    body = {"revision": desk.project.frames.get(frames[1]).revision, "changes": [{"kind": "reject", "uid": uid}]}
    answer = desk.live.client.post(
        f"{desk.api}/frames/{frames[1]}/changes", json=body | {"effort": None, "subject": None}
    )
    assert answer.status_code == 200
    desk.page.locator(f'[data-testid="frame-box"][data-uid="{uid}"][data-state="rejected"]').wait_for()
    # an unreadable frame shows its error instead of its image
    first, second, third = frames[:3]
    page, cache = desk.page, desk.live.context.caches.frames
    page.evaluate("localStorage.setItem('label-order', 'time')")
    truncated = FrameError(Path("people/depth/000001.png"), "the file is truncated", "copy it again")
    read = cache.open

    def broken(project: Project, frame_id: int, who: str = "") -> Any:
        if frame_id == second:
            raise truncated
        return read(project, frame_id, who)

    monkeypatch.setattr(cache, "open", broken)
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
        monkeypatch.setattr(cache, "open", read)
        page.get_by_test_id("frame-retry").click()
        expect(shown).to_have_attribute("src", re.compile(f"/frames/{second}/"))
        expect(problem).to_be_hidden()
        monkeypatch.setattr(cache, "open", broken)


def test_stale_and_failed_edits_are_neither_lost_nor_forced(desk: Desk, wait_for) -> None:
    frame, uid, before = desk.frame, desk.uid, desk.label.box
    for choice, decide in (("theirs", desk.project.labels.accept), ("mine", desk.project.labels.reject)):
        # a change that is not announced to the page
        decide(frame, uid, WriteContext(desk.project.frames.get(frame).revision, "Bob"))
        desk.press("f")
        desk.page.get_by_test_id("stale-dialog").wait_for()
        assert desk.label.state in (ReviewState.ACCEPTED, ReviewState.REJECTED)
        desk.page.get_by_test_id(f"dialog-{choice}").click()
        desk.page.get_by_test_id("stale-dialog").wait_for(state="detached")
        wanted = ReviewState.ACCEPTED if choice == "theirs" else ReviewState.EDITED
        wait_for(lambda wanted=wanted: desk.label.state is wanted)
        size = before.size_m if choice == "theirs" else before.size_m[[1, 0, 2]]
        np.testing.assert_allclose(desk.label.box.size_m, size, atol=1e-9)
        desk.settled()
        expect(desk.page.get_by_test_id("label-state")).to_have_text(wanted.value)
    # a box that could not be saved stays until it is saved or discarded, and the page asks before it leaves it
    page, here = desk.page, desk.page.url
    refuse(page, "changes")
    desk.press("f")
    expect(page.get_by_test_id("not-saved")).to_contain_text("Not saved")
    assert page.evaluate("!dispatchEvent(new Event('beforeunload', { cancelable: true }))")
    for leave in (
        lambda: desk.press("n"),
        lambda: desk.press("Control+z"),
        page.get_by_test_id("mode-statistics").click,
    ):
        leave()
        expect(page.get_by_test_id("unsaved-dialog")).to_contain_text("1 changed box")
        page.get_by_test_id("dialog-stay").click()
        expect(page).to_have_url(here)
    page.unroute("**/changes")
    page.get_by_test_id("draft-retry").click()
    wait_for(lambda: np.allclose(desk.label.box.size_m, before.size_m, atol=1e-9))
    expect(page.get_by_test_id("not-saved")).to_be_hidden()
    assert page.evaluate("dispatchEvent(new Event('beforeunload', { cancelable: true }))")
