"""Nothing moves while one works, in a real browser: whatever comes has a place that was kept for it."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from typing import TYPE_CHECKING

import pytest
from browser_page import Bench, Desk, drag_box
from drawing import Scene

from annotator.types import BoxKind, ReviewState
from annotator.workflows.workbench.loaded_detectors import Readiness, ReadyDetector

if TYPE_CHECKING:
    from pathlib import Path

    from playwright.sync_api import Page

    from annotator.workflows.detectors import Detectors

expect = pytest.importorskip("playwright.sync_api").expect

# every shift counts, also one right after an action: that is when the next one is aimed
WATCH = """() => {
  window.shifts = [];
  const name = ({ node }) => {
    const element = node?.nodeType === Node.TEXT_NODE ? node.parentElement : node;
    return `${element?.tagName} ${element?.className} ${element?.textContent.slice(0, 30)}`;
  };
  const keep = (entries) => window.shifts.push(...entries.map(({ value, sources }) => [value, ...sources.map(name)]));
  window.watching = new PerformanceObserver((list) => keep(list.getEntries()));
  window.watching.observe({ type: "layout-shift" });
}"""
SEEN = """async () => {
  await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(done))));
  const { x, y, width, height } = document.querySelector("img.picture[src]").getBoundingClientRect();
  return [[x, y, width, height], window.shifts];
}"""
LONG = "what is wrong, where it is and what to do about it; " * 12


class Still:
    """Asserts after each step that no element has moved, and that the camera image is where it was."""

    def __init__(self, page: Page) -> None:
        self.page = page
        page.evaluate(WATCH)
        self._picture, _ = page.evaluate(SEEN)

    def after(self, step: str) -> None:
        picture, shifts = self.page.evaluate(SEEN)
        assert shifts == [], step
        assert picture == self._picture, step


def test_nothing_jumps_along_the_box(
    desk: Desk,
    generated: Path,
    knowing: Callable[..., Detectors],
    monkeypatch: pytest.MonkeyPatch,
    wait_for: Callable[..., None],
) -> None:
    page, project = desk.page, desk.project
    ready = Readiness("ready", ReadyDetector(knowing("people").view, BoxKind.BOX, Lock()))
    monkeypatch.setattr(desk.live.context.caches.detectors, "readiness", lambda project, role, wait_s=None: ready)
    scene = Scene.of(generated / "people", project.frames.get(desk.frame).index or 0, ("person",))
    expect(page.locator("img.small-views").first).to_be_visible()
    still = Still(page)

    def states() -> list[ReviewState]:
        return [stored.label.state for stored in project.labels.select()]

    drag_box(page, "image-editor", scene.image_box(0), 320, 240)
    expect(page.get_by_test_id("label-state")).to_have_text("new")
    desk.settled()
    still.after("a box is drawn")
    desk.press("Space")
    wait_for(lambda: ReviewState.ACCEPTED in states())
    desk.settled()
    still.after("the new box is accepted")
    desk.press("v")
    expect(page.get_by_test_id("follow-close")).to_be_visible()
    desk.settled()
    still.after("it is followed")
    for key, state in (("f", ReviewState.EDITED), ("x", ReviewState.REJECTED), ("Space", ReviewState.ACCEPTED)):
        page.locator('[data-testid="frame-box"][data-state="proposed"]').first.click()
        desk.settled()
        still.after("another box is selected")
        count = states().count(state)
        desk.press(key)
        wait_for(lambda count=count, state=state: states().count(state) > count)
        desk.settled()
        still.after(key)
    desk.press("Control+z")
    wait_for(lambda: states().count(ReviewState.ACCEPTED) == count)
    desk.settled()
    still.after("undone")
    show = "([text, kind]) => import('/assets/js/messages.js').then(({ toast }) => toast(text, kind))"
    for text, kind in (("Saved", "good"), (LONG, "warn")):
        page.evaluate(show, [text, kind])
        expect(page.get_by_test_id(f"toast-{kind}")).to_be_visible()
        still.after(f"a message: {kind}")
    # a long one is cut, and shown whole when it is asked for
    message = page.get_by_test_id("toast-warn")
    assert message.locator(".text").evaluate("(one) => one.scrollWidth > one.clientWidth")
    message.locator(".text").click()
    assert LONG in message.evaluate("(one) => getComputedStyle(one, '::after').content")
    still.after("the message is shown whole")
    desk.press("Escape")
    expect(page.get_by_text("No box is selected.")).to_be_visible()
    still.after("nothing is selected")


def test_nothing_jumps_on_the_pseudo_views(
    bench: Bench, teach: Callable[..., None], knowing: Callable[..., Detectors]
) -> None:
    page, hint = bench.page, bench.page.get_by_test_id("image-note")
    teach(view=knowing("people", kind=BoxKind.SILHOUETTE).view)
    still = Still(page)
    bench.draw_on_image(0)
    expect(page.get_by_test_id("act-accept")).to_contain_text("Accept")
    still.after("a box is drawn, and the others are suggested")
    for key, text in (("Space", "finished"), ("f", "finished"), ("Control+z", "finished")):
        page.keyboard.press(key)
        expect(hint).to_contain_text(text)
        bench.saved()
        still.after(key)
    expect(page.get_by_test_id("frame-box")).to_have_count(1)
