"""Alignment in a real browser: sliders, the level, and what other modes show afterwards."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from browser_page import label_truth

from annotator.geometry.oriented_box import same_box
from annotator.project import Project
from annotator.recordings import open_recording
from annotator.types import Correction
from annotator.workflows.add_recordings import register_recording

if TYPE_CHECKING:
    from conftest import Shop
    from playwright.sync_api import Page, Route

expect = pytest.importorskip("playwright.sync_api").expect

FROM_FILES = "Known from the recording's files."


@pytest.fixture
def aligned(shared_page: Page, room: Project) -> Page:
    """Alignment mode on the first frame."""
    shared_page.goto(f"/#/{room.path.name}/alignment")
    expect(shared_page.get_by_test_id("correction-effect")).not_to_be_empty()
    return shared_page


def test_a_correction_and_a_level_are_tried_kept_and_undone(aligned: Page, shop: Shop, room: Project) -> None:
    count = label_truth(room, shop.recording, 2)
    before = room.labels.select()
    page, keep, source = aligned, aligned.get_by_test_id("keep-correction"), aligned.get_by_test_id("up-source")
    page.reload()
    expect(page.get_by_test_id("correction-effect")).to_contain_text(f"{count} 3D boxes")
    expect(keep).to_be_disabled()
    page.get_by_test_id("turn-y-field").fill("1.25")
    slider = page.get_by_test_id("shift-x")
    box = slider.bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + 0.9 * box["width"], box["y"] + box["height"] / 2)
    expect(keep).to_be_enabled()
    assert room.recordings.all()[0].correction == Correction()
    keep.click()
    expect(page.get_by_test_id("clear-correction")).to_be_enabled()
    kept = room.recordings.all()[0].correction
    assert kept.turn_rad[1] == pytest.approx(0.0218, abs=1e-4)
    assert 0.3 < kept.shift_m[0] < 0.5
    assert not any(same_box(a.label.box, b.label.box) for a, b in zip(before, room.labels.select(), strict=True))
    page.get_by_test_id("undo").click()
    expect(page.get_by_test_id("turn-y-field")).to_have_value("0.00")
    assert room.recordings.all()[0].correction == Correction()
    assert all(same_box(a.label.box, b.label.box) for a, b in zip(before, room.labels.select(), strict=True))

    expect(source).to_have_text(FROM_FILES)
    page.get_by_test_id("estimate-up").click()
    expect(source).to_contain_text("certainty")
    page.get_by_test_id("refuse-up").click()
    expect(source).to_have_text(FROM_FILES)
    page.get_by_test_id("roll-field").fill("7")
    expect(source).to_contain_text("not kept yet")
    page.get_by_test_id("keep-up").click()
    expect(source).to_have_text("Set in this project.")
    up = room.recordings.all()[0].up
    assert up is not None and up[0] == pytest.approx(0.12, abs=0.01)
    page.get_by_test_id("clear-up").click()
    expect(source).to_have_text(FROM_FILES)
    # a proposal stays one when the correction is kept first
    page.get_by_test_id("estimate-up").click()
    expect(source).to_contain_text("Proposed with certainty")
    page.get_by_test_id("turn-x-field").fill("1")
    keep.click()
    expect(page.get_by_test_id("clear-correction")).to_be_enabled()
    expect(source).to_contain_text("Proposed with certainty")
    page.get_by_test_id("keep-up").click()
    expect(source).to_have_text("Set in this project.")


def test_what_is_unknown_or_changed_by_others_is_explained_and_what_was_set_is_not_lost_unasked(
    aligned: Page, shop: Shop, room: Project, own_copy: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    register_recording(room, open_recording(own_copy("people")), name="other")
    page, keep = aligned, aligned.get_by_test_id("keep-up")
    held: list[Route] = []
    expect(keep).to_be_disabled()  # known from the files, and shown as it is

    def unknown(route: Route) -> None:
        answer = route.fetch()
        route.fulfill(response=answer, json={**answer.json(), "up": None, "up_source": "unknown"})

    # nothing can be set before the recording is known
    page.route("**/frames/*/alignment", lambda route: held.append(route))
    with page.expect_request("**/frames/*/alignment"):
        page.reload()
    expect(page.get_by_test_id("alignment-picture")).to_be_visible()
    expect(page.get_by_test_id("turn-x-field")).to_have_count(0)
    unknown(held[0])
    expect(page.get_by_test_id("turn-x-field")).to_have_value("0.00")
    page.unroute("**/frames/*/alignment")
    # a level of zero degrees is kept where none is known
    expect(page.get_by_test_id("up-source")).to_contain_text("Not known")
    expect(page.get_by_test_id("roll-field")).to_have_value("0.0")
    page.route("**/frames/*/alignment", unknown)
    page.get_by_test_id("mode-statistics").click()  # nothing was set, so that nothing is asked
    expect(page.get_by_test_id("statistics")).to_be_visible()
    page.go_back()
    keep.click()
    expect(page.get_by_test_id("up-source")).to_have_text("Set in this project.")
    assert room.recordings.all()[0].up == pytest.approx((0.0, -1.0, 0.0))
    page.unroute("**/frames/*/alignment")

    # another operator's adjustment is shown, also after a lost connection
    page.goto(f"/#/{room.path.name}/alignment/1")
    page.reload()
    expect(page.get_by_test_id("correction-effect")).not_to_be_empty()
    hub = shop.live.context.hub
    turn, image = page.get_by_test_id("turn-y-field"), page.get_by_test_id("image-editor").locator("img.picture[src]")
    # changes are made anew after it
    page.get_by_test_id("turn-x-field").fill("2")
    room.adjustments.correct(1, Correction((0.0, 0.02, 0.0)), "Bob")
    expect(page.get_by_text("Bob has adjusted this recording")).to_be_visible()
    page.get_by_test_id("discard-correction").click()
    expect(turn).to_have_value("1.15")
    # Label opens the frame anew
    page.goto(f"/#/{room.path.name}/annotate/1")
    image.wait_for()
    before = image.get_attribute("src")
    room.adjustments.correct(1, Correction((0.0, 0.03, 0.0)), "Bob")
    expect(page.get_by_text("Bob has changed this recording's calibration")).to_be_visible()
    expect(image).not_to_have_attribute("src", str(before))
    # made while there was no connection: before it is lost, so that the page cannot be back before it
    with monkeypatch.context() as patch:
        patch.setattr(shop.live.context.announcer, "announce", lambda *_: None)
        before = image.get_attribute("src")
        room.adjustments.correct(1, Correction((0.0, 0.04, 0.0)), "Bob")
    hub.close()
    expect(image).not_to_have_attribute("src", str(before))

    # what was set is not lost unasked in another mode or on another frame
    dialog, source = page.get_by_test_id("unsaved-dialog"), page.get_by_test_id("up-source")
    page.get_by_test_id("mode-alignment").click()
    expect(turn).to_have_value("2.29")
    page.get_by_test_id("turn-x-field").fill("2")
    page.get_by_test_id("mode-statistics").click()
    expect(dialog).to_contain_text("not kept yet")
    page.keyboard.press("Escape")
    page.get_by_test_id("discard-correction").click()
    expect(page.get_by_test_id("turn-x-field")).to_have_value("0.00")
    # on another frame, both halves stay, also when one of them is kept
    page.get_by_test_id("turn-x-field").fill("1.5")
    page.get_by_test_id("roll-field").fill("7")
    page.get_by_label("Next frame in time").click()
    expect(page.get_by_test_id("frame-position")).to_contain_text("2 /")
    expect(source).to_contain_text("not kept yet")
    expect(page.get_by_test_id("turn-x-field")).to_have_value("1.50")
    page.get_by_test_id("keep-correction").click()
    expect(page.get_by_test_id("clear-correction")).to_be_enabled()
    expect(source).to_contain_text("not kept yet")
    # on another recording it would be lost
    page.get_by_test_id("turn-x-field").fill("2")

    def other(answer: str) -> None:
        page.get_by_test_id("choose-recordings").click()
        page.get_by_test_id("recordings").get_by_role("button").filter(has_text="other").click()
        asked = page.get_by_role("dialog", name="Another recording")
        expect(asked).to_contain_text("not kept yet")
        asked.get_by_role("button", name=answer).click()
        expect(asked).to_have_count(0)

    other("Cancel")
    expect(page.get_by_test_id("recording-name")).not_to_have_text("other")
    expect(page.get_by_test_id("turn-x-field")).to_have_value("2")
    # a page that is left keeps what was set, or says why not
    page.get_by_test_id("mode-statistics").click()
    refused = {"error": {"kind": "ProjectError", "message": "the disk is full"}}
    page.route("**/correction", lambda route: route.fulfill(status=507, json=refused))
    keep = page.get_by_test_id("dialog-retry")
    expect(keep).to_have_text("Keep and continue")
    keep.click()
    expect(dialog).to_contain_text("the disk is full")
    page.unroute("**/correction")
    keep.click()
    expect(page.get_by_test_id("statistics")).to_be_visible()
    stored = room.recordings.all()[0]
    assert stored.correction.turn_rad[0] == pytest.approx(0.0349, abs=1e-4)
    assert stored.up is not None and stored.up[0] == pytest.approx(0.12, abs=0.02)
    page.get_by_test_id("mode-alignment").click()
    expect(page.get_by_test_id("turn-x-field")).to_have_value("2.00")
    page.get_by_test_id("turn-x-field").fill("3")
    other("Discard it")
    expect(page.get_by_test_id("recording-name")).to_have_text("other")
    expect(page.get_by_test_id("turn-x-field")).to_have_value("0.00")
