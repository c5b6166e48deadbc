"""Review in a real browser: the queue of proposals and its keys; attributes: fields, one key each, filters; frames,
also unreadable ones; stale and failed edits are not lost.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from browser_page import FRAMES, Desk, middle, refuse, until

from annotator.project import NewLabel, Project, WriteContext
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute
from annotator.types import ReviewState
from annotator.types.errors import FrameError

if TYPE_CHECKING:
    from playwright.sync_api import Locator

expect = pytest.importorskip("playwright.sync_api").expect


def test_the_whole_queue_is_accepted_with_one_key_per_proposal_also_after_a_reload(desk: Desk) -> None:
    page, shown = desk.page, desk.page.get_by_test_id("frame-position")
    items = page.get_by_test_id("queue-item").count()
    assert items >= 2 * FRAMES
    page.get_by_test_id("queue-order").select_option("time")
    expect(shown).to_have_text("1 / 5")
    desk.settled()
    page.reload()
    for number in range(1, FRAMES + 1):
        frame = desk.frame
        for _ in desk.project.labels.of_frame(frame):
            items -= 1
            desk.settled()
            assert desk.frame == frame
            desk.press("Space")
            expect(page.get_by_test_id("queue-item")).to_have_count(items)
        if number < FRAMES:
            expect(shown).to_have_text(f"{number + 1} / 5")
            desk.settled()
    page.get_by_test_id("review-done").wait_for()
    labels = desk.project.labels.select()
    assert {(stored.label.state, stored.label.author) for stored in labels} == {(ReviewState.ACCEPTED, "Grace")}
    statistics = desk.live.client.get(f"{desk.api}/statistics").json()
    assert statistics["effort"]["actions_a_box"] == 1
    assert statistics["accepted_untouched"] == 1, "a share"


def visit_another(desk: Desk) -> tuple[int, str]:
    """Opens another frame with proposals by its address, as keys and links do; returns its id, and its position."""
    ids = [stored.id for stored in desk.project.frames.of()]
    waiting = {stored.frame_id for stored in desk.project.labels.select(states=[ReviewState.PROPOSED])}
    place = next(place for place, frame in enumerate(ids) if frame in waiting - {desk.frame})
    position = f"{place + 1} / {len(ids)}"
    desk.page.goto(f"/#/{desk.name}/annotate/{ids[place]}")
    expect(desk.page.get_by_test_id("frame-position")).to_have_text(position)
    desk.settled()
    return ids[place], position


def test_a_frame_that_was_opened_by_itself_is_never_left_by_a_decision(desk: Desk, wait_for) -> None:
    page, project = desk.page, desk.project
    frame, position = visit_another(desk)
    boxes = len(project.labels.of_frame(frame))
    for left in range(boxes - 1, -1, -1):
        desk.press("x" if left == 1 else "Space")
        expect(page.locator('[data-testid="frame-box"][data-state="proposed"]')).to_have_count(left)
        expect(page.get_by_test_id("saving")).to_have_text("")
        assert desk.frame == frame
    wait_for(lambda: ReviewState.PROPOSED not in {label.state for label in project.labels.of_frame(frame)})
    # once more: the page says how to go on, and stays
    for key in ("Space", "Shift+Space"):
        desk.press(key)
        expect(page.get_by_text("All boxes of this frame are reviewed")).to_be_visible()
        expect(page.get_by_test_id("saving")).to_have_text("")
        assert desk.frame == frame
    expect(page.get_by_test_id("act-accept")).to_be_disabled()
    # in the queue, a decision goes on
    page.get_by_test_id("queue-item").first.click()
    expect(page.get_by_test_id("frame-position")).not_to_have_text(position)
    desk.settled()
    # its row has the frame's name in the bar
    number = page.get_by_test_id("frame-position").inner_text().split(" / ")[0]
    expect(page.locator('[data-testid="queue-item"][aria-current]')).to_contain_text(f"frame {number}")
    assert desk.label.state is ReviewState.PROPOSED
    # all of such a frame are accepted in it
    frame, position = visit_another(desk)
    desk.press("Shift+Space")
    wait_for(lambda: ReviewState.PROPOSED not in {label.state for label in project.labels.of_frame(frame)})
    expect(page.get_by_test_id("saving")).to_have_text("")
    assert desk.frame == frame
    expect(page.get_by_test_id("frame-position")).to_have_text(position)


def test_keys_and_clicks_change_decide_and_select_boxes(desk: Desk, wait_for) -> None:
    page, before, uid = desk.page, desk.label.box, desk.uid
    desk.project.configure(classes=("person", "chair"))
    page.reload()
    desk.settled()
    # the heading turns by 90 degrees and the corners stay
    desk.press("Shift+F")
    wait_for(lambda: desk.label.state is ReviewState.EDITED)
    turned = desk.label.box
    np.testing.assert_allclose(turned.size_m, before.size_m[[1, 0, 2]], atol=1e-9)
    np.testing.assert_allclose(turned.rotation[:, 0], before.rotation[:, 1], atol=1e-9)
    np.testing.assert_allclose(turned.center_m, before.center_m, atol=1e-9)
    desk.settled()
    desk.press("Control+z")
    wait_for(lambda: desk.project.labels.get(uid).label.state is ReviewState.PROPOSED)
    np.testing.assert_array_equal(desk.project.labels.get(uid).label.box.size_m, before.size_m)
    desk.settled()
    desk.press("Control+Shift+z")
    wait_for(lambda: desk.project.labels.get(uid).label.state is ReviewState.EDITED)
    np.testing.assert_array_equal(desk.project.labels.get(uid).label.box.size_m, turned.size_m)
    desk.settled()

    uids = [row.get_attribute("data-uid") for row in page.get_by_test_id("frame-box").all()]
    assert desk.uid == uid
    desk.press("Tab")
    second = uids[(uids.index(uid) + 1) % len(uids)]
    assert desk.uid == second
    desk.press("Shift+Tab")
    assert desk.uid == uid
    desk.press("2")
    wait_for(lambda: desk.label.label == "chair")
    desk.settled()
    # a click in the list, and on the image
    page.locator(f'[data-testid="frame-box"][data-uid="{second}"]').click()
    assert desk.uid == second
    desk.settled()
    desk.press("Escape")
    expect(page.locator('[data-testid="frame-box"][aria-current="true"]')).to_have_count(0)
    # overlays are redrawn with the next animation frame, so elements found before may be stale
    x, y = page.evaluate(
        """uid => new Promise((tell) => requestAnimationFrame(() => requestAnimationFrame(() => {
            const lines = document.querySelector(`[data-testid=editor-overlay][data-id="${uid}"]`);
            const box = lines.getBoundingClientRect();
            tell([box.x + box.width / 2, box.y + 0.8 * box.height]);
        })))""",
        second,
    )
    page.mouse.click(x, y)
    page.locator('[data-testid="frame-box"][aria-current="true"]').wait_for()
    page.locator(f'[data-testid="frame-box"][data-uid="{second}"]').click()
    desk.settled()
    desk.press("x")
    wait_for(lambda: desk.project.labels.get(str(second)).label.state is ReviewState.REJECTED)
    desk.settled()
    gone, frame = desk.uid, desk.frame
    desk.press("Delete")
    wait_for(lambda: gone not in {label.uid for label in desk.project.labels.of_frame(frame)})


def test_filters_leave_room_for_the_queue_and_say_what_they_hide(desk: Desk, wait_for) -> None:
    page, project = desk.page, desk.project
    project.configure(classes=("person", "chair"))
    helmet = Attribute.model_validate({"name": "helmet", "kind": "boolean"})
    project.change_classes(edit.PutAttribute(attribute=helmet), "Ada")
    theirs = [NewLabel("person", label.box, 0.1, 1234) for label in project.labels.of_frame(desk.frame)]
    project.proposals.bring("a long name of a detector", {desk.frame: theirs})
    page.reload()
    desk.settled()
    source = page.get_by_test_id("queue-source")
    count = len(theirs)
    expect(source.locator("option").last).to_have_text(f"a long name of a detector ({count})")

    # the counts follow what is reviewed
    desk.press("Space")
    expect(source.locator("option").last).to_have_text(f"a long name of a detector ({count - 1})")
    desk.settled()

    value = page.get_by_test_id("queue-attribute")
    choices = ["All attributes", "helmet: none", "helmet: yes", "helmet: no", "helmet: any"]
    expect(value.locator("option")).to_have_text(choices)
    value.select_option("helmet: yes")
    queue = page.get_by_test_id("queue")
    expect(queue).to_contain_text("No proposal matches the filter")
    expect(page.get_by_test_id("review-done")).to_be_hidden()
    page.get_by_test_id("queue-clear").click()
    expect(value).to_have_value("")
    expect(page.get_by_test_id("queue-item")).not_to_have_count(0)


SCHEMA = [
    {"name": "pose", "kind": "choice", "choices": ["sitting", "standing"], "key": "o", "required": True},
    {"name": "note", "kind": "text", "key": "t"},
    {"name": "mass", "kind": "number", "maximum": 100, "key": "m"},
    {"name": "rain", "kind": "boolean", "of": "frame", "key": "r", "default": False},
]


def with_attributes(desk: Desk) -> None:
    """Gives the project attributes, and opens it anew."""
    for fields in SCHEMA:
        desk.project.change_classes(edit.PutAttribute(attribute=Attribute.model_validate(fields)), "Ada")
    desk.project.change_classes(edit.AddClass(name="chair", style={"key": "c"}), "Ada")
    desk.page.reload()
    desk.settled()


def values_of(desk: Desk, uid: str) -> dict[str, object]:
    return dict(desk.project.labels.get(uid).label.attributes)


def test_fields_and_keys_set_values_and_the_queue_filters_by_them(desk: Desk, wait_for) -> None:
    with_attributes(desk)
    page, project = desk.page, desk.project
    uid = desk.uid
    expect(page.get_by_test_id("attributes")).to_be_visible()

    def values() -> dict[str, object]:
        return values_of(desk, uid)

    desk.press("Alt+o")
    wait_for(lambda: values() == {"pose": "sitting"})
    expect(page.get_by_test_id("attribute-pose").locator("option:checked")).to_have_text("sitting")
    expect(page.get_by_test_id("label-facts")).to_contain_text("until it is reviewed")
    desk.settled()
    desk.press("Alt+o")
    wait_for(lambda: values() == {"pose": "standing"})
    desk.settled()
    page.get_by_test_id("attribute-pose").select_option(label="sitting")
    wait_for(lambda: values() == {"pose": "sitting"})
    desk.settled()
    desk.press("Alt+m")
    expect(page.get_by_test_id("attribute-mass")).to_be_focused()
    page.keyboard.type("81.5")
    desk.press("Tab")
    wait_for(lambda: values() == {"pose": "sitting", "mass": 81.5})
    desk.settled()
    desk.press("Alt+r")
    wait_for(lambda: project.frames.attributes().get(desk.frame) == {"rain": True})
    desk.settled()
    desk.press("Control+z")
    wait_for(lambda: project.frames.attributes() == {})
    desk.settled()

    page.get_by_test_id("queue-attribute").select_option("pose=sitting")
    expect(page.get_by_test_id("queue-item")).to_have_count(1)
    assert desk.uid == uid
    # the values are at the box, and in its row
    expect(page.get_by_test_id("image-editor").get_by_text("pose=sitting, mass=81.5")).to_be_visible()
    expect(page.locator(f'[data-testid="frame-box"][data-uid="{uid}"]')).to_have_attribute(
        "title", "pose=sitting, mass=81.5"
    )
    page.get_by_test_id("queue-attribute").select_option("mass~")
    expect(page.get_by_test_id("queue-low")).to_be_focused()
    page.keyboard.type("82")
    page.keyboard.press("Enter")
    expect(page.get_by_test_id("queue-remaining")).to_have_text("0 proposals")
    page.get_by_test_id("queue-attribute").select_option("rain=true")
    expect(page.get_by_test_id("queue-low")).to_be_hidden()
    page.get_by_test_id("queue-attribute").select_option("pose=")
    expect(page.get_by_test_id("queue-remaining")).not_to_have_text("0 proposals")
    expect(page.get_by_test_id("queue-remaining")).not_to_have_text("1 proposal")
    wait_for(lambda: desk.uid != uid)
    desk.settled()
    other = desk.uid
    desk.press("Alt+c")
    wait_for(lambda: project.labels.get(other).label.label == "chair")


def test_what_is_typed_is_stored_on_its_box_however_it_is_left(desk: Desk, wait_for) -> None:
    with_attributes(desk)
    page, project, selected = desk.page, desk.project, '[data-testid="frame-box"][aria-current="true"]'
    mass, note = page.get_by_test_id("attribute-mass"), page.get_by_test_id("attribute-note")

    def left(uid: str) -> None:
        page.locator(f'{selected}:not([data-uid="{uid}"])').wait_for()
        desk.settled()
        for field in (mass, note, page.get_by_test_id("field-track")):
            expect(field).to_have_value("")
        assert not values_of(desk, desk.uid)

    # a text, and a click on another box, here and in another frame
    here = page.locator('[data-testid="frame-box"]:not([aria-current="true"])').first
    there = next(one for one in project.labels.select() if one.frame_id != desk.frame).label.uid
    for other in (here, page.locator(f'[data-testid="queue-item"][data-uid="{there}"]')):
        uid = desk.uid
        note.focus()
        page.keyboard.type("seen")
        other.click()
        left(uid)
        wait_for(lambda uid=uid: values_of(desk, uid) == {"note": "seen"})
    # a number, and a key that decides or leaves the frame
    for field, key, state in (
        ("attribute-mass", "Space", ReviewState.ACCEPTED),
        ("attribute-mass", "x", ReviewState.REJECTED),
        ("field-track", "x", ReviewState.REJECTED),
    ):
        uid = desk.uid
        page.get_by_test_id(field).focus()
        page.keyboard.type("81")
        desk.press(key)
        left(uid)
        stored = project.labels.get(uid).label
        assert (stored.attributes.get("mass"), stored.track_id) == ((81.0, None) if "mass" in field else (None, 81))
        assert stored.state is state
    expect(page.locator("#toasts .toast-error")).to_have_count(0)

    # a field shows the stored value again after a refusal
    for typed, shown in (("99", "99"), ("1e", "99"), ("102", "99")):
        mass.focus()
        desk.press("Control+a")
        page.keyboard.type(typed)
        desk.press("Enter")
        desk.settled()
        expect(mass).to_have_value(shown)
    expect(page.get_by_test_id("toast-error")).to_contain_text("mass")


def test_a_click_counts_though_the_page_is_drawn_again_while_the_button_is_down(desk: Desk, wait_for) -> None:
    with_attributes(desk)
    page, project = desk.page, desk.project
    here, tracked = desk.frame, desk.uid
    desk.press("Alt+r")
    page.get_by_test_id("field-track").fill("7")
    desk.press("Tab")
    wait_for(lambda: desk.label.track_id == 7)
    there = next(one for one in project.labels.select() if one.frame_id != here).label.uid
    elsewhere = project.frames.get(project.labels.get(there).frame_id)
    body = {"revision": elsewhere.revision, "changes": [{"kind": "track", "uid": there, "track_id": 7}]}
    assert desk.live.client.post(f"{desk.api}/frames/{elsewhere.id}/changes", json=body).status_code == 200
    # the small pictures of the list come while the button is down
    held: list[Route] = []
    is_held = True
    page.route("**/sheet", lambda route: held.append(route) if is_held else route.continue_())
    page.reload()
    desk.settled()
    until(page, lambda: held)

    def press(target: Locator) -> None:
        """Clicks slowly: what was typed is stored, and another operator's change is shown, before the release."""
        target.scroll_into_view_if_needed()
        page.mouse.move(*middle(target))
        page.mouse.down()
        desk.settled()
        nonlocal is_held
        if is_held:
            is_held = False
            # those before the last one were for an older revision of the frame, and are ended by the page
            held[-1].continue_()
            page.locator("img.small-views").first.wait_for()
        rain = not project.frames.attributes().get(desk.frame, {}).get("rain", False)
        body = {"revision": project.frames.get(desk.frame).revision, "uid": None, "values": {"rain": rain}}
        assert desk.live.client.post(f"{desk.api}/frames/{desk.frame}/attributes", json=body).status_code == 200
        expect(page.get_by_test_id("attribute-rain").locator("option:checked")).to_have_text("yes" if rain else "no")
        page.mouse.up()

    def select(target: Locator, uid: str) -> None:
        before = desk.uid
        page.get_by_test_id("attribute-note").fill(f"of {before}")
        press(target)
        page.locator(f'[data-testid="frame-box"][data-uid="{uid}"][aria-current="true"]').wait_for()
        desk.settled()
        assert values_of(desk, before) == {"note": f"of {before}"}

    item = lambda uid: page.locator(f'[data-testid="queue-item"][data-uid="{uid}"]')  # noqa: E731
    other = next(label.uid for label in project.labels.of_frame(here) if label.uid != tracked)
    assert desk.uid == tracked
    select(page.locator(f'[data-testid="frame-box"][data-uid="{other}"]'), other)
    select(item(tracked), tracked)
    select(item(there), there)
    select(item(other), other)
    press(page.get_by_test_id("act-reject"))
    wait_for(lambda: project.labels.get(other).label.state is ReviewState.REJECTED)
    desk.settled()
    press(page.get_by_test_id("mode-train"))
    page.get_by_test_id("learning").wait_for()


def test_frames_are_changed_finalised_and_shown_with_their_problem(
    desk: Desk, wait_for, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = [stored.id for stored in desk.project.frames.of()]
    desk.page.goto(f"/#/{desk.name}/annotate/{frames[0]}")
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
    truncated = FrameError(Path("people/depth/000001.png"), "the file is truncated", "copy it again")
    read = cache.open

    def broken(project: Project, frame_id: int, who: str = "") -> Any:
        if frame_id == second:
            raise truncated
        return read(project, frame_id, who)

    monkeypatch.setattr(cache, "open", broken)
    problem = page.get_by_test_id("frame-problem")
    page.goto(f"/#/{desk.name}/annotate/{first}")
    shown = page.get_by_test_id("image-editor").locator("img.picture")
    expect(shown).to_have_attribute("src", re.compile(f"/frames/{first}/"))
    page.get_by_role("button", name="Next frame in time").click()
    expect(problem).to_contain_text("the file is truncated")
    expect(problem).to_contain_text("copy it again")
    expect(shown).to_be_hidden()
    expect(page.locator('[data-testid="frame-box"], [data-testid="object"]')).to_have_count(0)
    expect(page).to_have_url(re.compile(f"/annotate/{second}$"))
    page.get_by_test_id("frame-next").click()
    expect(page).to_have_url(re.compile(f"/annotate/{third}$"))
    expect(problem).to_be_hidden()
    page.get_by_role("button", name="Previous frame in time").click()
    expect(problem).to_be_visible()
    monkeypatch.setattr(cache, "open", read)
    page.get_by_test_id("frame-retry").click()
    expect(shown).to_have_attribute("src", re.compile(f"/frames/{second}/"))
    expect(problem).to_be_hidden()


def test_stale_and_failed_edits_are_neither_lost_nor_forced(desk: Desk, wait_for) -> None:
    page, items = desk.page, desk.page.get_by_test_id("queue-item")
    # a decision that cannot be saved is shown again, though the queue's next frame is shown meanwhile
    page.get_by_test_id("queue-order").select_option("time")
    expect(page.get_by_test_id("frame-position")).to_have_text("1 / 5")
    desk.settled()
    left = items.count()
    for _ in range(len(desk.project.labels.of_frame(desk.frame)) - 1):
        desk.press("Space")
        left -= 1
        expect(items).to_have_count(left)
        desk.settled()
    frame, uid, before = desk.frame, desk.uid, desk.label.box
    refuse(page, "changes")
    with page.expect_event("requestfailed", lambda request: request.url.endswith(f"/frames/{frame}/changes")):
        desk.press("Space")
    page.locator(f'[data-testid="frame-box"][data-uid="{uid}"][aria-current="true"]').wait_for()
    expect(items).to_have_count(left)
    desk.settled()
    assert (desk.frame, desk.uid, desk.label.state) == (frame, uid, ReviewState.PROPOSED)
    page.unroute("**/changes")
    for choice, decide in (("theirs", desk.project.labels.accept), ("mine", desk.project.labels.reject)):
        # a change that is not announced to the page
        decide(frame, uid, WriteContext(desk.project.frames.get(frame).revision, "Bob"))
        desk.press("Shift+F")
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
    here = page.url
    refuse(page, "changes")
    desk.press("Shift+F")
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
