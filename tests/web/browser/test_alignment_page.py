"""Alignment in a real browser: sliders, the level, and what other modes show afterwards."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from browser_page import label_truth, sign_in

from annotator.geometry.oriented_box import same_box
from annotator.project import Project
from annotator.types import Correction

if TYPE_CHECKING:
    from conftest import Shop
    from playwright.sync_api import Page, Route

expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect


@pytest.fixture
def aligned(shared_page: Page, shop: Shop, room: Project) -> Page:
    """Alignment mode on the first frame."""
    sign_in(shared_page, shop.live.url)
    shared_page.goto(f"/#/{room.path.name}/alignment")
    expect(shared_page.get_by_test_id("correction-effect")).not_to_be_empty()
    return shared_page


def test_a_correction_is_tried_kept_and_undone(aligned: Page, shop: Shop, room: Project) -> None:
    count = label_truth(room, shop.recording, 2)
    before = room.labels.select()
    page, keep = aligned, aligned.get_by_test_id("keep-correction")
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


def test_changes_can_be_discarded_and_are_not_lost_unasked(aligned: Page) -> None:
    page = aligned
    page.get_by_test_id("turn-x-field").fill("2")
    page.get_by_test_id("mode-statistics").click()
    expect(page.locator("dialog[open]")).to_be_visible()
    page.keyboard.press("Escape")
    page.get_by_test_id("discard-correction").click()
    expect(page.get_by_test_id("turn-x-field")).to_have_value("0.00")
    page.get_by_test_id("mode-statistics").click()
    expect(page.get_by_test_id("statistics")).to_be_visible()


def test_a_page_that_is_left_keeps_what_was_set_or_says_why_not(aligned: Page, room: Project) -> None:
    page, dialog = aligned, aligned.get_by_test_id("unsaved-dialog")
    page.get_by_test_id("turn-x-field").fill("2")
    page.get_by_test_id("roll-field").fill("7")
    page.get_by_test_id("mode-statistics").click()
    expect(dialog).to_contain_text("not kept yet")
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


def test_a_level_of_zero_degrees_is_kept_where_none_is_known(aligned: Page, room: Project) -> None:
    page, keep = aligned, aligned.get_by_test_id("keep-up")
    expect(keep).to_be_disabled()  # known from the files, and shown as it is

    def unknown(route: Route) -> None:
        answer = route.fetch()
        route.fulfill(response=answer, json={**answer.json(), "up": None, "up_source": "unknown"})

    page.route("**/frames/*/alignment", unknown)
    page.reload()
    expect(page.get_by_test_id("up-source")).to_contain_text("Not known")
    expect(page.get_by_test_id("roll-field")).to_have_value("0.0")
    page.get_by_test_id("mode-statistics").click()  # nothing was set, so that nothing is asked
    expect(page.get_by_test_id("statistics")).to_be_visible()
    page.go_back()
    keep.click()
    expect(page.get_by_test_id("up-source")).to_have_text("Set in this project.")
    assert room.recordings.all()[0].up == pytest.approx((0.0, -1.0, 0.0))


def test_a_level_is_proposed_turned_kept_and_cleared(aligned: Page, room: Project) -> None:
    page, source = aligned, aligned.get_by_test_id("up-source")
    expect(source).to_have_text("Known from the recording's files.")
    page.get_by_test_id("estimate-up").click()
    expect(source).to_contain_text("certainty")
    page.get_by_test_id("refuse-up").click()
    expect(source).to_have_text("Known from the recording's files.")
    page.get_by_test_id("roll-field").fill("7")
    expect(source).to_contain_text("not kept yet")
    page.get_by_test_id("keep-up").click()
    expect(source).to_have_text("Set in this project.")
    up = room.recordings.all()[0].up
    assert up is not None
    assert up[0] == pytest.approx(0.12, abs=0.01)
    page.get_by_test_id("clear-up").click()
    expect(source).to_have_text("Known from the recording's files.")


def test_label_mode_opens_the_frame_anew_after_a_correction_by_another(
    aligned: Page, shop: Shop, room: Project
) -> None:
    page, name = aligned, room.path.name
    page.goto(f"/#/{name}/label/1")
    page.get_by_test_id("image-editor").locator("img.picture[src]").wait_for()
    room.adjustments.correct(1, Correction((0.0, 0.02, 0.0)), "Bob")
    expect(page.get_by_text("Bob has changed this recording's calibration")).to_be_visible()
    expect(page.get_by_test_id("image-editor").locator("img.picture[src*='adjusted=']")).to_be_visible()


def test_what_was_not_kept_yet_stays_on_another_frame_and_when_the_other_half_is_kept(
    aligned: Page, room: Project
) -> None:
    page = aligned
    page.get_by_test_id("turn-x-field").fill("2")
    page.get_by_test_id("roll-field").fill("7")
    page.get_by_label("Next frame in time").click()
    expect(page.get_by_test_id("frame-position")).to_contain_text("2 /")
    expect(page.get_by_test_id("up-source")).to_contain_text("not kept yet")
    expect(page.get_by_test_id("turn-x-field")).to_have_value("2.00")
    page.get_by_test_id("keep-correction").click()
    expect(page.get_by_test_id("clear-correction")).to_be_enabled()
    expect(page.get_by_test_id("up-source")).to_contain_text("not kept yet")
    page.get_by_test_id("keep-up").click()
    expect(page.get_by_test_id("up-source")).to_have_text("Set in this project.")
    stored = room.recordings.all()[0]
    assert stored.correction.turn_rad[0] == pytest.approx(0.0349, abs=1e-4)
    assert stored.up is not None and stored.up[0] == pytest.approx(0.12, abs=0.02)


def test_a_proposal_stays_one_when_the_correction_is_kept_first(aligned: Page, room: Project) -> None:
    page, source = aligned, aligned.get_by_test_id("up-source")
    page.get_by_test_id("estimate-up").click()
    expect(source).to_contain_text("Proposed with certainty")
    page.get_by_test_id("turn-x-field").fill("1")
    page.get_by_test_id("keep-correction").click()
    expect(page.get_by_test_id("clear-correction")).to_be_enabled()
    expect(source).to_contain_text("Proposed with certainty")
    page.get_by_test_id("keep-up").click()
    expect(source).to_have_text("Set in this project.")


def test_the_level_that_the_files_give_another_frame_is_no_change_by_hand(aligned: Page) -> None:
    page, source = aligned, aligned.get_by_test_id("up-source")

    def turned(route: Route) -> None:
        answer = route.fetch()
        route.fulfill(response=answer, json={**answer.json(), "up": [0.6, -0.8, 0.0]})

    page.route("**/frames/2/alignment", turned)
    page.get_by_label("Next frame in time").click()
    expect(page.get_by_test_id("roll-field")).to_have_value("36.9")
    expect(source).to_have_text("Known from the recording's files.")


def test_nothing_can_be_set_before_the_recording_is_known(aligned: Page) -> None:
    page, aside, held = aligned, aligned.locator(".alignment-mode .aside"), list["Route"]()

    def hold(route: Route) -> None:
        held.append(route)

    page.route("**/frames/*/alignment", hold)
    with page.expect_request("**/frames/*/alignment"):
        page.reload()
    expect(aside).to_have_attribute("inert", "")
    expect(page.get_by_test_id("turn-x-field")).to_have_value("0.00")
    held[0].continue_()
    expect(aside).not_to_have_attribute("inert", "")


def test_frames_and_images_that_cannot_be_read_are_explained(aligned: Page) -> None:
    page = aligned
    broken = {"error": {"kind": "FrameError", "message": "000001.png: is damaged"}}
    page.route("**/frames/2", lambda route: route.fulfill(status=422, json=broken))
    page.get_by_label("Next frame in time").click()
    problem = page.get_by_test_id("frame-problem")
    expect(problem).to_contain_text("000001.png: is damaged")
    page.get_by_test_id("turn-x-field").fill("1")
    expect(page.get_by_test_id("keep-correction")).to_be_disabled()
    page.route("**/frames/3/recorded.jpg", lambda route: route.fulfill(status=422, json=broken))
    page.get_by_test_id("frame-next").click()
    expect(problem).to_be_hidden()
    expect(page.get_by_test_id("turn-x-field")).to_have_value("1.00")
    expect(page.get_by_test_id("alignment-problem")).to_contain_text("000001.png: is damaged")
    page.get_by_test_id("discard-correction").click()


def test_changes_are_made_anew_after_another_operators(aligned: Page, room: Project) -> None:
    page = aligned
    page.get_by_test_id("turn-x-field").fill("2")
    room.adjustments.correct(1, Correction((0.0, 0.02, 0.0)), "Bob")
    expect(page.get_by_text("Bob has adjusted this recording")).to_be_visible()
    page.get_by_test_id("discard-correction").click()
    expect(page.get_by_test_id("turn-y-field")).to_have_value("1.15")
    page.get_by_test_id("turn-x-field").fill("1")
    # the button is also disabled while the answer is awaited
    with page.expect_response(lambda response: response.request.method != "GET"):
        page.get_by_test_id("keep-correction").click()
    expect(page.get_by_test_id("keep-correction")).to_be_disabled()
    assert room.recordings.all()[0].correction.turn_rad[0] == pytest.approx(0.01745, abs=1e-4)


@pytest.mark.parametrize(
    ("mode", "shown"),
    [
        ("alignment", "[data-testid=turn-y-field]"),
        ("label", "[data-testid=image-editor] img.picture[src*='adjusted=']"),
    ],
)
def test_an_adjustment_made_while_there_was_no_connection_is_shown(
    aligned: Page, shop: Shop, room: Project, monkeypatch: pytest.MonkeyPatch, mode: str, shown: str
) -> None:
    page, hub = aligned, shop.live.context.hub
    monkeypatch.setattr(hub, "recording_adjusted", lambda *_: None)
    page.goto(f"/#/{room.path.name}/{mode}/1")
    page.locator("img.picture[src]" if mode == "label" else shown).first.wait_for()
    # before the connection is lost, so that the page cannot be back before it
    room.adjustments.correct(1, Correction((0.0, 0.02, 0.0)), "Bob")
    hub.close()
    expect(page.locator(shown)).to_be_visible()
    if mode == "alignment":
        expect(page.locator(shown)).to_have_value("1.15")
