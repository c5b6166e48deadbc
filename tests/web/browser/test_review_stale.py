"""Review in a real browser: stale and failed edits are neither lost nor forced."""

from __future__ import annotations

import numpy as np
import pytest
from browser_page import refuse
from review_desk import Desk

from annotator.project import WriteContext
from annotator.types import ReviewState

expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect


@pytest.mark.parametrize("choice", ["theirs", "mine"])
def test_a_stale_edit_shows_both_versions_in_review(desk: Desk, wait_for, choice: str) -> None:
    frame, uid, before = desk.frame, desk.uid, desk.label.box
    # a change that is not announced to the page
    context = WriteContext(desk.project.frames.get(frame).revision, "Bob")
    desk.project.labels.accept(frame, uid, context)
    desk.press("f")
    desk.page.get_by_test_id("stale-dialog").wait_for()
    assert desk.label.state is ReviewState.ACCEPTED
    desk.page.get_by_test_id(f"dialog-{choice}").click()
    desk.page.get_by_test_id("stale-dialog").wait_for(state="detached")
    wanted = ReviewState.ACCEPTED if choice == "theirs" else ReviewState.EDITED
    wait_for(lambda: desk.label.state is wanted)
    size = before.size_m if choice == "theirs" else before.size_m[[1, 0, 2]]
    np.testing.assert_allclose(desk.label.box.size_m, size, atol=1e-9)
    desk.settled()
    assert desk.page.get_by_test_id("label-state").inner_text() == wanted.value


def test_a_box_that_could_not_be_saved_stays_until_it_is_saved_or_discarded(desk: Desk, wait_for) -> None:
    page, first, here = desk.page, desk.uid, desk.page.url
    size = desk.label.box.size_m
    refuse(page, "changes")
    desk.press("f", "Tab")
    row = page.locator(f'[data-testid="frame-box"][data-uid="{first}"]')
    expect(row).to_contain_text("not saved")
    assert desk.uid != first
    row.click()
    expect(page.get_by_test_id("not-saved")).to_contain_text("Not saved")
    assert float(page.get_by_test_id("field-size-length").input_value()) == pytest.approx(size[1], abs=6e-4)
    assert page.evaluate("!dispatchEvent(new Event('beforeunload', { cancelable: true }))")

    # the page asks before it leaves the unsaved box
    for key in ("n", "Control+z"):
        desk.press(key)
        page.get_by_test_id("unsaved-dialog").wait_for()
        page.get_by_test_id("dialog-retry").click()
        expect(page.get_by_test_id("unsaved-dialog").get_by_role("alert")).to_contain_text("1 changed box")
        page.get_by_test_id("dialog-stay").click()
        expect(page).to_have_url(here)
        assert desk.uid == first
    page.get_by_test_id("mode-statistics").click()
    page.get_by_test_id("dialog-stay").click()
    expect(page).to_have_url(here)
    expect(page.get_by_test_id("not-saved")).to_be_visible()

    page.unroute("**/changes")
    page.get_by_test_id("draft-retry").click()
    wait_for(lambda: desk.project.labels.get(first).label.state is ReviewState.EDITED)
    np.testing.assert_allclose(desk.label.box.size_m, size[[1, 0, 2]], atol=1e-9)
    expect(page.get_by_test_id("not-saved")).to_be_hidden()
    assert page.evaluate("dispatchEvent(new Event('beforeunload', { cancelable: true }))")

    refuse(page, "changes")
    desk.press("f")
    page.get_by_test_id("draft-discard").click()
    expect(page.get_by_test_id("label-state")).to_have_text("edited")
    desk.press("n")
    expect(page).not_to_have_url(here)


# Server states in this order, and the state that the page shows after each.
OVERTAKING = """async () => {
  const load = (name) => import(`/assets/js/${name}.js`);
  const { createFrameState } = await load("frame_state");
  const { createState } = await load("state");
  const picture = (project, id) => ({ url: `/${project}/${id}` });
  const frame = (revision, id = 1, project = "room") => ({
    frame: { id, revision }, image: picture(project, id), siblings: [],
  });
  let answer = frame(3);
  const app = { state: createState({ frame: null }), path: () => "", api: { get: async () => answer } };
  const frames = createFrameState(app);
  const seen = [];
  const tell = (...more) => seen.push([app.state.frame.frame.revision, frames.isBehind, ...more]);
  await frames.open(1), tell();
  tell(frames.take(frame(2)));
  tell(frames.take(frame(5, 1, "another")));
  tell(frames.take(frame(5)));
  frames.hear({ frame: 1, revision: 6 }), frames.hear({ frame: 2, revision: 9 }), tell();
  answer = frame(6);
  await frames.refresh(() => false), tell();
  await frames.refresh(), tell();
  answer = frame(4);
  await frames.open(1), tell();
  frames.miss(), tell();
  answer = frame(6);
  await frames.refresh(), tell();
  const later = [frame(8, 2), frame(9, 2)];
  app.api.get = async () => later.shift();
  await frames.open(2), tell();
  return seen;
}"""


def test_an_older_answer_never_replaces_a_newer_state(desk: Desk) -> None:
    assert desk.page.evaluate(OVERTAKING) == [
        [3, False],
        [3, False, False],
        [3, False, False],
        [5, False, True],
        [5, True],
        [5, True],
        [6, False],
        [6, False],
        [6, True],
        [6, False],
        [9, False],
    ]
