"""Label mode in a real browser: five drags per object, each saved at once."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from browser_page import drag_box, draw_on_views, until
from label_bench import EDGES, FRAME, Bench

from annotator.geometry.iou import iou_3d
from annotator.project.classes import edit
from annotator.types import BoxKind, ReviewState

expect = pytest.importorskip("playwright.sync_api").expect

if TYPE_CHECKING:
    from playwright.sync_api import Request

    from annotator.project import ProjectConfig
    from annotator.project.classes.edit import ClassEdit


# Enter confirms a whole box after it was on the screen for a moment.
SEEN_MS = 400


def _close(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return all(abs(a[edge] - b[edge]) < 0.5 for edge in EDGES)


def test_a_new_object_takes_five_drags(bench: Bench) -> None:
    bench.draw_object(0)
    (label,) = bench.labels
    assert label.label == "person"
    assert label.state is ReviewState.ACCEPTED
    assert iou_3d(label.box, bench.scene.objects[0].box) > 0.5
    row = bench.page.get_by_test_id("object")
    expect(row).to_have_attribute("data-boxes", "5")
    expect(row).to_have_attribute("data-uid", label.uid)
    expect(bench.page.get_by_test_id("hint")).to_contain_text("finished")
    overlay = bench.page.get_by_test_id("image-editor").get_by_test_id("editor-overlay").first
    expect(overlay).to_have_attribute("data-id", label.uid)
    effort = bench.live.client.get(f"{bench.api}/statistics").json()["effort"]
    assert effort["boxes"] == 1
    assert effort["actions_a_box"] == 5
    assert effort["seconds_a_box"] > 0


# Presses Enter at the moment at which a whole box is shown, and holds it down.
HASTE = """new MutationObserver((_, observer) => {
  if (!document.querySelector("[data-testid=image-editor] [data-id=whole]")) return;
  observer.disconnect();
  const press = (repeat) =>
    document.body.dispatchEvent(new KeyboardEvent("keydown", { key: "Enter", repeat, bubbles: true }));
  press(false);
  setTimeout(press, 500, true);
  setTimeout(() => document.body.setAttribute("data-pressed", ""), 600);
}).observe(document.body, { childList: true, subtree: true })"""


def test_a_whole_box_is_offered_and_enter_confirms_it(bench: Bench) -> None:
    bench.page.evaluate(HASTE)
    bench.draw_object(0)
    page, (seen,) = bench.page, bench.labels
    page.locator("body[data-pressed]").wait_for()
    # a key that was meant for something else confirms nothing
    bench.saved()
    assert seen.box_kind is bench.labels[0].box_kind is BoxKind.SILHOUETTE
    whole_box = page.locator("[data-testid=image-editor] [data-testid=editor-overlay][data-id=whole]")
    hint = page.get_by_test_id("hint")
    expect(whole_box).to_have_count(1)
    expect(hint).to_contain_text("Enter confirms the dashed box as the whole person")
    # another kind of boxes, and back
    page.keyboard.press("b")
    until(page, lambda: bench.labels[0].box_kind is BoxKind.BOX)
    bench.saved()
    page.keyboard.press("b")
    expect(whole_box).to_have_count(1)
    page.wait_for_timeout(SEEN_MS)
    # nothing is stored until the operator confirms one
    assert bench.labels[0].box_kind is BoxKind.SILHOUETTE
    dashed = whole_box.locator("> path.halo")
    first = dashed.get_attribute("d")
    page.keyboard.press("w")
    is_only_one = "W shows" not in hint.inner_text()
    until(page, lambda: (dashed.get_attribute("d") == first) == is_only_one)
    page.keyboard.press("Enter")
    expect(whole_box).to_have_count(0)
    bench.saved()
    (whole,) = bench.labels
    assert (whole.uid, whole.box_kind) == (seen.uid, BoxKind.BOX)
    assert not np.allclose(whole.box.size_m, seen.box.size_m)
    # the silhouettes stay, and the object is not offered another box
    assert bench.page.get_by_test_id("object").get_attribute("data-boxes") == "5"
    assert bench.state["image_boxes"]["box_kind"] == "silhouette"
    expect(hint).to_contain_text("finished")
    page.keyboard.press("Control+z")
    until(page, lambda: bench.labels[0].box_kind is BoxKind.SILHOUETTE)
    # the offer is back
    expect(whole_box).to_have_count(1)
    page.wait_for_timeout(SEEN_MS)
    page.keyboard.press("Enter")
    until(page, lambda: bench.labels[0].box_kind is BoxKind.BOX)


def test_each_drag_is_saved_at_once_and_survives_a_reload(bench: Bench) -> None:
    first = bench.draw_on_image(0)
    bench.saved()
    assert _close(bench.image_boxes[0], bench.scene.image_box(0))
    front = first["steps"][0]["views"][0]
    draw_on_views(bench.page, bench.scene, 0, first["steps"][0]["views"])
    bench.saved()
    bench.page.reload()
    row = bench.page.get_by_test_id("object")
    row.wait_for()
    assert row.get_attribute("data-boxes") == "3"
    row.get_by_role("button").first.click()
    bench.wait_for_view(0, front)
    expect(bench.page.get_by_test_id("view-front").get_by_test_id("editor-box")).to_have_count(1)


def test_a_box_on_the_side_view_alone_is_restored_after_a_reload(bench: Bench) -> None:
    views = bench.draw_on_image(0)["steps"][0]["views"]
    bench.wait_for_view(1, views[1])
    bench.draw_on_view(1, views[1], bench.scene.view_box(0, views[1]))
    bench.saved()
    # the detectors are loaded before an object is drawn
    with bench.page.expect_request("**/models/load"):
        bench.page.reload()
    bench.page.get_by_test_id("object").get_by_role("button").first.click()
    bench.page.get_by_test_id("view-side").get_by_test_id("editor-box").wait_for(state="attached")
    assert bench.page.get_by_test_id("view-front").get_by_test_id("editor-box").count() == 0


def test_correcting_a_view_box_updates_the_label(bench: Bench) -> None:
    bench.draw_object(0)
    (before,) = bench.labels
    bench.page.get_by_test_id("view-front-2").get_by_test_id("editor2d").focus()
    bench.page.keyboard.press("Alt+Shift+ArrowRight")
    bench.page.wait_for_timeout(700)
    bench.saved()
    (after,) = bench.labels
    assert after.uid == before.uid
    assert not np.allclose(after.box.size_m, before.box.size_m)


def _metres(state: dict[str, Any]) -> np.ndarray:
    """The extent of the boxes of the frame's only object on its views, metres along their axes."""
    views = state["objects"][0]["views"]
    px = np.array([[[box[edge] for edge in EDGES[:2]], [box[edge] for edge in EDGES[2:]]] for _, box in views])
    scale, origin = (np.array([view[name] for view, _ in views]) for name in ("metres_per_px", "origin_m"))
    found: np.ndarray = px * scale[:, None, None] + origin[:, None]
    return found


def test_boxes_on_views_follow_a_moved_image_box_or_nothing_is_saved(bench: Bench) -> None:
    bench.draw_object(0)
    page, before = bench.page, bench.state
    (label,) = bench.labels
    problem = page.get_by_test_id("save-problem")

    def move(key: str) -> None:
        page.get_by_test_id("image-editor").get_by_test_id("editor-box").click(force=True)
        for _ in range(6):
            page.keyboard.press(key)

    # the request for the new views fails
    page.route("**/label/steps", lambda route: route.abort())
    move("ArrowRight")
    problem.get_by_role("button", name="Try again").wait_for()
    assert bench.state == before
    expect(page.locator(".views img.picture[src]")).to_have_count(0)
    page.unroute("**/label/steps")
    problem.get_by_role("button", name="Try again").click()
    expect(problem).to_have_text("")
    bench.saved()
    moved = bench.state
    assert moved["image_boxes"]["boxes"][0]["x_min"] > before["image_boxes"]["boxes"][0]["x_min"] + 5
    assert moved["objects"][0]["views"][0][0]["origin_m"] != before["objects"][0]["views"][0][0]["origin_m"]
    np.testing.assert_allclose(_metres(moved), _metres(before), atol=1e-6)
    assert page.locator(".views .box.suggested").count() == 0, "the second step's views keep their axes"

    # the answer arrives after the object was deselected
    held: list[Any] = []
    page.route("**/label/steps", lambda route: route.continue_() if held else held.append(route))
    move("ArrowLeft")
    until(page, lambda: held)
    for _ in ("its box", "itself"):
        page.keyboard.press("Escape")
    expect(page.get_by_test_id("object").locator("[aria-current=true]")).to_have_count(0)
    held[0].continue_()
    bench.saved()
    assert _close(bench.image_boxes[0], before["image_boxes"]["boxes"][0])
    np.testing.assert_allclose(_metres(bench.state), _metres(before), atol=1e-6)
    assert [known.uid for known in bench.labels] == [label.uid]
    np.testing.assert_allclose(bench.labels[0].box.center_m, label.box.center_m, atol=1e-6)


def test_undo_and_redo_work_on_single_drags(bench: Bench) -> None:
    bench.draw_object(0)
    row = bench.page.get_by_test_id("object")
    bench.page.keyboard.press("Control+z")
    bench.page.wait_for_selector('[data-testid="object"][data-boxes="4"]')
    assert bench.labels == []
    bench.page.get_by_test_id("undo").click()
    bench.page.wait_for_selector('[data-testid="object"][data-boxes="3"]')
    bench.page.keyboard.press("Control+Shift+z")
    bench.page.wait_for_selector('[data-testid="object"][data-boxes="4"]')
    bench.page.keyboard.press("Control+y")
    bench.page.wait_for_selector('[data-testid="object"][data-boxes="5"]')
    assert row.get_attribute("data-uid") == bench.labels[0].uid


def test_deleting_an_object_deletes_its_label_and_boxes(bench: Bench) -> None:
    bench.draw_object(0)
    bench.page.get_by_role("button", name="Delete this person").click()
    bench.saved()
    assert bench.labels == []
    assert bench.image_boxes == []
    bench.page.keyboard.press("Control+z")
    bench.page.get_by_test_id("object").wait_for()
    assert len(bench.labels) == 1


def test_a_finalised_frame_accepts_no_boxes_until_it_is_reopened(bench: Bench) -> None:
    bench.page.get_by_test_id("finalise").click()
    bench.saved()
    assert "finalised" in bench.hint
    drag_box(bench.page, "image-editor", bench.scene.image_box(0), 320, 240)
    assert bench.page.get_by_test_id("object").count() == 0
    bench.page.keyboard.press("Control+Enter")
    bench.saved()
    bench.draw_on_image(0)
    bench.saved()
    assert len(bench.image_boxes) == 1


def test_the_kind_of_boxes_is_saved(bench: Bench) -> None:
    bench.draw_on_image(0)
    bench.saved()
    assert bench.state["image_boxes"]["box_kind"] == "silhouette"
    bench.page.keyboard.press("b")
    bench.saved()
    assert bench.state["image_boxes"]["box_kind"] == "box"


def test_another_operators_boxes_appear_without_a_reload(bench: Bench) -> None:
    bench.other_saves(bench.scene.image_box(1))
    bench.page.get_by_test_id("object").wait_for()


def _save_in_between(bench: Bench, box: dict[str, Any]) -> None:
    """Lets another operator save just before this page's next drag is saved."""

    done: list[bool] = []

    def save_first(route: Any) -> None:
        if not done:
            done.append(True)
            bench.other_saves(box)
        route.continue_()

    bench.page.route("**/label/object", save_first)


def test_a_stale_edit_shows_both_versions_and_can_be_saved_on_top(bench: Bench) -> None:
    theirs, mine = bench.scene.image_box(1), bench.scene.image_box(0)
    _save_in_between(bench, theirs)
    bench.draw_on_image(0)
    dialog = bench.page.get_by_test_id("stale-dialog")
    dialog.wait_for()
    assert dialog.get_by_role("img").count() == 2
    bench.page.get_by_test_id("dialog-mine").click()
    dialog.wait_for(state="detached")
    bench.saved()
    assert [_close(kept, drawn) for kept, drawn in zip(bench.image_boxes, (theirs, mine), strict=True)] == [True, True]
    assert bench.page.get_by_test_id("object").count() == 2


def test_after_taking_the_other_version_the_own_box_can_still_be_saved(bench: Bench) -> None:
    theirs, mine = bench.scene.image_box(1), bench.scene.image_box(0)
    _save_in_between(bench, theirs)
    bench.draw_on_image(0)
    bench.page.get_by_test_id("dialog-theirs").click()
    bench.saved()
    assert len(bench.image_boxes) == 1
    assert bench.page.get_by_test_id("object").count() == 1
    assert bench.page.get_by_test_id("image-editor").get_by_text("yours, not saved").count() == 1
    bench.page.keyboard.press("Enter")
    expect(bench.page.get_by_test_id("object")).to_have_count(2)
    bench.saved()
    assert _close(bench.image_boxes[1], mine)


def test_keys_change_the_frame_and_the_key_table_lists_them(bench: Bench) -> None:
    bench.page.get_by_test_id("order").select_option("time")
    bench.page.keyboard.press("n")
    bench.page.wait_for_url("**/label/2")
    expect(bench.page.get_by_test_id("frame-position")).to_have_text("2 / 5")
    bench.page.keyboard.press("p")
    bench.page.wait_for_url("**/label/1")
    bench.page.keyboard.press("?")
    table = bench.page.get_by_test_id("key-table")
    table.wait_for()
    assert table.get_by_text("Accept, then go to the next").count() == 1
    bench.page.keyboard.press("Escape")
    table.wait_for(state="detached")


def test_a_failed_save_is_shown_and_can_be_retried(bench: Bench) -> None:
    bench.page.route("**/label/object", lambda route: route.abort())
    bench.drag_on_image(0)
    problem = bench.page.get_by_test_id("save-problem")
    problem.get_by_role("button", name="Try again").wait_for()
    assert bench.image_boxes == []
    assert bench.page.evaluate("!dispatchEvent(new Event('beforeunload', { cancelable: true }))")
    for leave in (lambda: bench.page.keyboard.press("n"), bench.page.get_by_test_id("mode-review").click):
        leave()
        bench.page.get_by_test_id("unsaved-dialog").wait_for()
        bench.page.get_by_test_id("dialog-stay").click()
        bench.page.get_by_test_id("unsaved-dialog").wait_for(state="detached")
        expect(bench.page).to_have_url(re.compile(f"/label/{FRAME}$"))
    bench.page.unroute("**/label/object")
    problem.get_by_role("button", name="Try again").click()
    expect(problem).to_have_text("")
    bench.saved()
    assert len(bench.image_boxes) == 1


def _while_saving(bench: Bench, change: Callable[[ProjectConfig], ClassEdit]) -> None:
    """Lets another operator change the classes just before this page's next drag is saved."""
    done: list[bool] = []

    def change_first(route: Any) -> None:
        if not done:
            done.append(True)
            bench.project.change_classes(change, "Bob")
        route.continue_()

    bench.page.route("**/label/object", change_first)


def test_a_box_whose_class_is_renamed_before_it_is_saved_gets_the_new_name(bench: Bench) -> None:
    _while_saving(bench, lambda config: edit.rename_class(config, "person", "human"))
    bench.drag_on_image(0)
    # refused at first, and sent again as soon as the page knows the new name
    expect(bench.page.get_by_test_id("object")).to_contain_text("human")
    bench.saved()
    expect(bench.page.get_by_test_id("save-problem")).to_have_text("")
    assert [box["label"] for box in bench.image_boxes] == ["human"]


@pytest.mark.parametrize("is_kept", [True, False])
def test_a_box_whose_class_is_removed_before_it_is_saved_gets_another_or_is_discarded(
    bench: Bench, is_kept: bool
) -> None:
    bench.project.change_classes(lambda config: edit.add_class(config, "dog"), "Bob")
    _while_saving(bench, lambda config: edit.remove_class(config, "person"))
    bench.drag_on_image(0)
    problem = bench.page.get_by_test_id("save-problem")
    expect(problem).to_contain_text("'person' is not a class")
    expect(problem.get_by_test_id("save-as").locator("option")).to_have_text(["save it as …", "dog"])
    if is_kept:
        problem.get_by_test_id("save-as").select_option("dog")
    else:
        problem.get_by_role("button", name="Discard").click()
    expect(problem).to_have_text("")
    bench.saved()
    assert [box["label"] for box in bench.image_boxes] == ["dog"] * is_kept
    expect(bench.page.get_by_test_id("object")).to_have_count(int(is_kept))


def test_the_next_frame_is_prefetched_and_navigation_cancels_that(bench: Bench) -> None:
    page = bench.page
    page.evaluate("localStorage.setItem('label-order', 'time')")
    with page.expect_request("**/frames/2/image.jpg*"):
        page.reload()
    assert page.url.endswith("/label/1")
    with page.expect_request("**/frames/5") as asked, page.expect_event("requestfailed", _asks_for_frame(5)):
        page.route("**/frames/5", lambda route: None)
        page.evaluate("location.hash = location.hash.replace(/1$/, '4')")
        page.get_by_test_id("image-editor").locator("img.picture[src*='frames/4/']").wait_for()
        page.wait_for_timeout(1500)
        page.keyboard.press("p")
    assert asked.value.failure is not None
    page.wait_for_url("**/label/3")


def _asks_for_frame(number: int) -> Callable[[Request], bool]:
    return lambda request: request.url.endswith(f"/frames/{number}")
