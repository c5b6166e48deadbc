"""Review in a real browser: the queue of proposals and its keys."""

from __future__ import annotations

import numpy as np
import pytest
from review_desk import FRAMES, Desk

from annotator.project import NewLabel
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute
from annotator.types import ReviewState

expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect


def test_the_whole_queue_can_be_accepted_with_one_key_per_proposal(desk: Desk, wait_for) -> None:
    items = desk.page.get_by_test_id("queue-item").count()
    assert items >= 2 * FRAMES
    for left in range(items - 1, -1, -1):
        desk.press("Space")
        expect(desk.page.get_by_test_id("queue-item")).to_have_count(left)
        desk.settled()
    desk.page.get_by_test_id("review-done").wait_for()
    labels = desk.project.labels.select()
    assert {(stored.label.state, stored.label.author) for stored in labels} == {(ReviewState.ACCEPTED, "Ada")}
    statistics = desk.live.client.get(f"{desk.api}/statistics").json()
    assert statistics["effort"]["actions_a_box"] == 1
    assert statistics["accepted_untouched"] == 1, "a share"


def visit_another(desk: Desk) -> tuple[int, str]:
    """Opens another frame with proposals by its address, as keys and links do; returns its id, and its position."""
    ids = [stored.id for stored in desk.project.frames.of()]
    place = next(place for place, frame in enumerate(ids) if frame != desk.frame)
    position = f"{place + 1} / {len(ids)}"
    desk.page.goto(f"/#/{desk.name}/review/{ids[place]}")
    expect(desk.page.get_by_test_id("frame-position")).to_have_text(position)
    desk.settled()
    return ids[place], position


@pytest.mark.parametrize("key", ["Space", "x"])
def test_a_frame_that_was_opened_by_itself_is_left_only_when_asked(desk: Desk, wait_for, key: str) -> None:
    frame, position = visit_another(desk)
    boxes = len(desk.project.labels.of_frame(frame))
    for left in range(boxes - 1, -1, -1):
        desk.press(key)
        expect(desk.page.locator('[data-testid="frame-box"][data-state="proposed"]')).to_have_count(left)
        expect(desk.page.get_by_test_id("saving")).to_have_text("")
        assert desk.frame == frame
    wait_for(lambda: ReviewState.PROPOSED not in {label.state for label in desk.project.labels.of_frame(frame)})
    # now the same key that accepts goes on: to the queue, where each decision does
    expect(desk.page.get_by_test_id("act-accept")).to_contain_text("Next")
    for decided in range(3):
        desk.press("Space")
        expect(desk.page.get_by_test_id("frame-position")).not_to_have_text(position)
        desk.settled()
        assert desk.frame != frame
        assert desk.label.state is ReviewState.PROPOSED
        items = desk.page.get_by_test_id("queue-item").count()
        assert items == len(desk.project.labels.select(states=[ReviewState.PROPOSED])) > decided


@pytest.mark.parametrize("is_looked_away", [False, True])
def test_the_queue_goes_on_after_a_reload_but_not_from_a_frame_that_the_operator_has_chosen(
    desk: Desk, is_looked_away: bool
) -> None:
    shown = desk.page.get_by_test_id("frame-position")
    desk.page.get_by_test_id("queue-order").select_option("time")
    expect(shown).to_have_text("1 / 5")
    desk.settled()
    first = desk.frame
    if is_looked_away:
        desk.press("n")
        expect(shown).to_have_text("2 / 5")
        desk.press("p")
        expect(shown).to_have_text("1 / 5")
    desk.page.reload()
    for _ in desk.project.labels.of_frame(first):
        desk.settled()
        assert desk.frame == first
        desk.press("Space")
    if is_looked_away:
        desk.settled()
        assert desk.frame == first
        # goes on when asked
        desk.press("Space")
    expect(shown).to_have_text("2 / 5")


def test_all_of_a_frame_that_was_opened_by_itself_are_accepted_in_it(desk: Desk, wait_for) -> None:
    frame, position = visit_another(desk)
    desk.press("Shift+Space")
    wait_for(lambda: {label.state for label in desk.project.labels.of_frame(frame)} == {ReviewState.ACCEPTED})
    expect(desk.page.get_by_test_id("saving")).to_have_text("")
    assert desk.frame == frame
    desk.press("Shift+Space")
    expect(desk.page.get_by_test_id("frame-position")).not_to_have_text(position)


def test_a_deletion_stays_in_the_frame_and_the_queue_goes_on_with_a_key(desk: Desk, wait_for) -> None:
    frame = desk.frame
    for left in range(len(desk.project.labels.of_frame(frame)) - 1, -1, -1):
        desk.press("Delete")
        wait_for(lambda left=left: len(desk.project.labels.of_frame(frame)) == left)
        expect(desk.page.get_by_test_id("frame-box")).to_have_count(left)
        expect(desk.page.get_by_test_id("saving")).to_have_text("")
        assert desk.frame == frame
    # nothing is selected any more
    expect(desk.page.get_by_test_id("act-reject")).to_be_disabled()
    accept = desk.page.get_by_test_id("act-accept")
    expect(accept).to_be_enabled()
    accept.click()
    desk.settled()
    assert desk.frame != frame and desk.label.state is ReviewState.PROPOSED


# Reports five changes while the queue waits to be read again; returns the waiting and the cancelled timers, and after
# the first one has fired, the requests, the number of proposals, and the waiting timers after one more change.
READ_AGAIN = """async () => {
  const { createQueue } = await import("/assets/js/review/queue.js");
  const [timers, cancelled, asked] = [[], [], []];
  const [wait, cancel] = [window.setTimeout, window.clearTimeout];
  const get = async (url) => (asked.push(url), { items: [], remaining: 37 });
  const app = { api: { get }, path: (...parts) => parts.join("/"), toast() {} };
  try {
    window.setTimeout = (fn) => timers.push(fn);
    window.clearTimeout = (timer) => timer && cancelled.push(timer);
    const queue = createQueue(app, () => {});
    for (let i = 0; i < 5; i += 1) queue.reloadSoon();
    const before = [timers.length, cancelled.length];
    timers[0]();
    await new Promise((resolve) => wait(resolve));
    queue.reloadSoon();
    return [before, asked.filter((url) => !url.includes("sources")).length, queue.remaining, timers.length];
  } finally {
    [window.setTimeout, window.clearTimeout] = [wait, cancel];
  }
}"""


def test_the_queue_is_read_again_while_changes_keep_coming(desk: Desk) -> None:
    """As when an object is followed: a frame changes several times a second."""
    assert desk.page.evaluate(READ_AGAIN) == [[1, 0], 1, 37, 2]


def test_an_edit_can_be_undone_and_redone(desk: Desk, wait_for) -> None:
    before, uid = desk.label.box, desk.uid
    desk.press("f")
    wait_for(lambda: desk.label.state is ReviewState.EDITED)
    turned = desk.label.box
    desk.settled()
    desk.press("Control+z")
    wait_for(lambda: desk.project.labels.get(uid).label.state is ReviewState.PROPOSED)
    np.testing.assert_array_equal(desk.project.labels.get(uid).label.box.size_m, before.size_m)
    desk.settled()
    desk.press("Control+Shift+z")
    wait_for(lambda: desk.project.labels.get(uid).label.state is ReviewState.EDITED)
    np.testing.assert_array_equal(desk.project.labels.get(uid).label.box.size_m, turned.size_m)


def test_the_heading_turns_by_90_degrees_and_the_corners_stay(desk: Desk, wait_for) -> None:
    before = desk.label.box
    desk.press("f")
    wait_for(lambda: desk.label.state is ReviewState.EDITED)
    after = desk.label.box
    np.testing.assert_allclose(after.size_m, before.size_m[[1, 0, 2]], atol=1e-9)
    np.testing.assert_allclose(after.rotation[:, 0], before.rotation[:, 1], atol=1e-9)
    np.testing.assert_allclose(after.center_m, before.center_m, atol=1e-9)


def test_keys_reject_delete_select_and_set_the_class(desk: Desk, wait_for) -> None:
    desk.project.configure(classes=("person", "chair"))
    desk.page.reload()
    desk.settled()
    uids = [row.get_attribute("data-uid") for row in desk.page.get_by_test_id("frame-box").all()]
    first = desk.uid
    desk.press("Tab")
    assert desk.uid == uids[(uids.index(first) + 1) % len(uids)]
    desk.press("Shift+Tab")
    assert desk.uid == first
    desk.press("2")
    wait_for(lambda: desk.label.label == "chair")
    desk.settled()
    second = uids[(uids.index(first) + 1) % len(uids)]
    desk.press("Tab", "x")
    wait_for(lambda: desk.project.labels.get(str(second)).label.state is ReviewState.REJECTED)
    desk.settled()
    gone = desk.uid
    frame = desk.frame
    desk.press("Delete")
    wait_for(lambda: gone not in {label.uid for label in desk.project.labels.of_frame(frame)})


def test_a_box_is_selected_by_a_click_on_the_image_or_in_the_list(desk: Desk) -> None:
    page = desk.page
    other = page.locator('[data-testid="frame-box"]:not([aria-current="true"])').first
    uid = other.get_attribute("data-uid")
    other.click()
    assert desk.uid == uid
    desk.settled()
    page.keyboard.press("Escape")
    expect(page.locator('[data-testid="frame-box"][aria-current="true"]')).to_have_count(0)
    # overlays are redrawn with the next animation frame, so elements found before may be stale
    x, y = page.evaluate(
        """uid => new Promise((tell) => requestAnimationFrame(() => requestAnimationFrame(() => {
            const lines = document.querySelector(`[data-testid=editor-overlay][data-id="${uid}"]`);
            const box = lines.getBoundingClientRect();
            tell([box.x + box.width / 2, box.y + 0.8 * box.height]);
        })))""",
        uid,
    )
    page.mouse.click(x, y)
    page.locator('[data-testid="frame-box"][aria-current="true"]').wait_for()


def test_filters_leave_room_for_the_queue_and_say_what_they_hide(desk: Desk, wait_for) -> None:
    page, project = desk.page, desk.project
    project.configure(classes=("person", "chair"))
    helmet = Attribute.model_validate({"name": "helmet", "kind": "boolean"})
    project.change_classes(lambda config: edit.put_attribute(config, helmet), "Ada")
    theirs = [NewLabel("person", label.box, 0.1, 1234) for label in project.labels.of_frame(desk.frame)]
    project.proposals.bring("a long name of a detector", {desk.frame: theirs})
    page.reload()
    desk.settled()
    source = page.get_by_test_id("queue-source")
    count = len(theirs)
    expect(source.locator("option").last).to_have_text(f"a long name of a detector ({count})")
    page.locator("img.small-views").first.wait_for()
    for width, height in ((1280, 720), (1440, 900), (1366, 768)):
        page.set_viewport_size({"width": width, "height": height})
        shown, first = (
            page.get_by_test_id("queue").bounding_box(),
            page.get_by_test_id("queue-item").first.bounding_box(),
        )
        assert shown is not None and first is not None
        assert shown["height"] >= 3 * first["height"]
        pictures = page.get_by_test_id("frame-boxes").bounding_box()
        assert pictures is not None and pictures["height"] >= shown["height"]

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
