"""The pseudo-views in a real browser: five drags an object, each saved; or one drag and Space with detectors."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from browser_page import EDGES, FRAME, Bench, answers_drag, drag_box, draw_on_views, until

from annotator.detection import pretrained
from annotator.geometry.iou import iou_3d
from annotator.project.classes import edit
from annotator.types import BoxKind, ReviewState, Suggestion

if TYPE_CHECKING:
    from playwright.sync_api import Request

    from annotator.project import ProjectConfig
    from annotator.project.classes.edit import ClassEdit
    from annotator.workflows.detectors import Detectors


expect = pytest.importorskip("playwright.sync_api").expect


# Enter confirms a whole box after it was on the screen for a moment.
SEEN_MS = 400


def _close(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return all(abs(a[edge] - b[edge]) < 0.5 for edge in EDGES)


def test_an_object_takes_five_drags_and_each_step_can_be_undone(bench: Bench) -> None:
    page, row, box = bench.page, bench.page.get_by_test_id("object"), bench.page.get_by_test_id("frame-box")
    assert "no WebGL" in page.get_by_test_id("viewport-note").inner_text()
    bench.draw_object(0)
    (seen,) = bench.labels
    assert (seen.label, seen.state, seen.author) == ("person", ReviewState.ACCEPTED, "Grace")
    assert iou_3d(seen.box, bench.scene.objects[0].box) > 0.5
    expect(box).to_have_attribute("data-uid", seen.uid)
    expect(box).to_have_attribute("aria-current", "true")
    hint = page.get_by_test_id("image-note")
    effort = bench.live.client.get(f"{bench.api}/statistics").json()["effort"]
    assert (effort["boxes"], effort["actions_a_box"]) == (1, 5)
    assert effort["seconds_a_box"] > 0
    bench.saved()
    assert seen.box_kind is bench.labels[0].box_kind is BoxKind.SILHOUETTE
    whole_box = page.locator("[data-testid=image-editor] [data-testid=editor-overlay][data-id=whole]")
    expect(whole_box).to_have_count(1)
    expect(hint).to_contain_text("Space takes the dashed box as the whole person")
    page.wait_for_timeout(SEEN_MS)
    # nothing is stored until the operator confirms one
    assert bench.labels[0].box_kind is BoxKind.SILHOUETTE
    dashed = whole_box.locator("> path.halo")
    first = dashed.get_attribute("d")
    page.keyboard.press("w")
    is_only_one = "W shows" not in hint.inner_text()
    until(page, lambda: (dashed.get_attribute("d") == first) == is_only_one)
    page.keyboard.press("Space")
    expect(whole_box).to_have_count(0)
    bench.saved()
    (whole,) = bench.labels
    assert (whole.uid, whole.box_kind) == (seen.uid, BoxKind.BOX)
    assert not np.allclose(whole.box.size_m, seen.box.size_m)
    # the silhouettes stay, and the object is not offered another box
    expect(page.locator(".views .box:not(.suggested)")).to_have_count(4)
    assert bench.state["image_boxes"]["box_kind"] == "silhouette"
    expect(hint).to_contain_text("finished")
    page.keyboard.press("Control+z")
    until(page, lambda: bench.labels[0].box_kind is BoxKind.SILHOUETTE)
    # the offer is back
    expect(whole_box).to_have_count(1)
    # a corrected box on a view updates the label, and each drag can be undone
    before = bench.labels[0]
    page.get_by_test_id("view-front-2").get_by_test_id("editor2d").focus()
    page.keyboard.press("Alt+Shift+ArrowRight")
    until(page, lambda: not np.allclose(bench.labels[0].box.size_m, before.box.size_m))
    bench.saved()
    assert bench.labels[0].uid == before.uid
    page.keyboard.press("Control+z")
    until(page, lambda: np.allclose(bench.labels[0].box.size_m, before.box.size_m))
    page.keyboard.press("Control+z")
    expect(row).to_have_attribute("data-boxes", "4")
    assert bench.labels == []
    page.get_by_test_id("undo").click()
    expect(row).to_have_attribute("data-boxes", "3")
    page.keyboard.press("Control+Shift+z")
    expect(row).to_have_attribute("data-boxes", "4")
    page.keyboard.press("Control+y")
    expect(box).to_have_count(1)
    assert box.get_attribute("data-uid") == bench.labels[0].uid
    box.click()
    page.keyboard.press("Delete")
    bench.saved()
    assert bench.labels == [] and bench.image_boxes == []
    page.keyboard.press("Control+z")
    box.wait_for()
    assert len(bench.labels) == 1


def _metres(state: dict[str, Any]) -> np.ndarray:
    """The extent of the boxes of the frame's only object on its views, metres along their axes."""
    views = state["objects"][0]["views"]
    px = np.array([[[box[edge] for edge in EDGES[:2]], [box[edge] for edge in EDGES[2:]]] for _, box in views])
    scale, origin = (np.array([view[name] for view, _ in views]) for name in ("metres_per_px", "origin_m"))
    found: np.ndarray = px * scale[:, None, None] + origin[:, None]
    return found


def test_boxes_on_views_follow_a_moved_image_box_or_nothing_is_saved(bench: Bench) -> None:
    page, row = bench.page, bench.page.get_by_test_id("object")
    first = bench.draw_on_image(0)
    bench.saved()
    assert _close(bench.image_boxes[0], bench.scene.image_box(0))
    # each drag survives a reload, after which the detectors are loaded before an object is drawn
    with page.expect_request("**/models/load"):
        page.reload()
    expect(row).to_have_attribute("data-boxes", "1")
    row.get_by_role("button").first.click()
    draw_on_views(page, bench.scene, 0, first["steps"][0]["views"])
    bench.saved()
    page.reload()
    expect(row).to_have_attribute("data-boxes", "3")
    # opens the pseudo-views, too
    row.get_by_role("button").first.click()
    bench.wait_for_view(0, first["steps"][0]["views"][0])
    expect(page.get_by_test_id("view-front").get_by_test_id("editor-box")).to_have_count(1)
    before = bench.state
    problem = page.get_by_test_id("save-problem")

    def move(key: str) -> None:
        box = page.get_by_test_id("image-editor").get_by_test_id("editor-box")
        box.wait_for()
        box.click(force=True)
        for _ in range(6):
            page.keyboard.press(key)

    # the boxes on the views are saved with it, or nothing is
    page.route("**/label/object", lambda route: route.abort())
    move("ArrowRight")
    problem.get_by_role("button", name="Try again").wait_for()
    assert bench.state == before
    page.unroute("**/label/object")
    problem.get_by_role("button", name="Try again").click()
    expect(problem).to_have_text("")
    bench.saved()
    moved = bench.state
    assert moved["image_boxes"]["boxes"][0]["x_min"] > before["image_boxes"]["boxes"][0]["x_min"] + 5
    assert moved["objects"][0]["views"][0][0]["origin_m"] != before["objects"][0]["views"][0][0]["origin_m"]
    np.testing.assert_allclose(_metres(moved), _metres(before), atol=1e-6)


def _save_in_between(bench: Bench, save: Callable[[], object]) -> None:
    """Lets another operator save just before this page's next drag is saved."""
    done: list[bool] = []

    def save_first(route: Any) -> None:
        if not done:
            done.append(True)
            save()
        route.continue_()

    bench.page.unroute("**/label/object")
    bench.page.route("**/label/object", save_first)


def test_a_stale_edit_shows_both_versions_and_neither_is_lost(bench: Bench) -> None:
    page, row = bench.page, bench.page.get_by_test_id("object")
    _save_in_between(bench, lambda: bench.other_saves(bench.scene.image_box(1)))
    bench.draw_on_image(0)
    dialog = page.get_by_test_id("stale-dialog")
    dialog.wait_for()
    assert dialog.get_by_role("img").count() == 2
    page.get_by_test_id("dialog-mine").click()
    dialog.wait_for(state="detached")
    bench.saved()
    theirs, mine = bench.scene.image_box(1), bench.scene.image_box(0)
    assert [_close(kept, drawn) for kept, drawn in zip(bench.image_boxes, (theirs, mine), strict=True)] == [True, True]
    expect(row).to_have_count(2)
    # after taking the other version, the own box can still be saved
    other = {**theirs, "x_min": theirs["x_min"] + 5}
    _save_in_between(bench, lambda: bench.other_saves(other))
    page.keyboard.press("Escape")
    with page.expect_response("**/label/object"):
        bench.drag_on_image(2)
    page.get_by_test_id("dialog-theirs").click()
    bench.saved()
    expect(row).to_have_count(3)
    assert len(bench.image_boxes) == 3
    expect(page.get_by_test_id("image-editor").get_by_text("yours, not saved")).to_have_count(1)
    page.get_by_test_id("image-editor").locator(".box.suggested rect.line").click(force=True)
    expect(row).to_have_count(4)
    bench.saved()
    assert _close(bench.image_boxes[3], bench.scene.image_box(2))


def test_a_failed_save_or_class_is_shown_and_nothing_is_lost(bench: Bench) -> None:
    page, problem = bench.page, bench.page.get_by_test_id("save-problem")
    row = page.get_by_test_id("object")

    def change(change: Callable[[ProjectConfig], ClassEdit]) -> None:
        bench.project.change_classes(change, "Ada")

    page.route("**/label/object", lambda route: route.abort())
    bench.drag_on_image(1)
    problem.get_by_role("button", name="Try again").wait_for()
    assert bench.image_boxes == []
    assert page.evaluate("!dispatchEvent(new Event('beforeunload', { cancelable: true }))")
    for leave in (lambda: page.keyboard.press("n"), page.get_by_test_id("mode-train").click):
        leave()
        page.get_by_test_id("unsaved-dialog").wait_for()
        page.get_by_test_id("dialog-stay").click()
        page.get_by_test_id("unsaved-dialog").wait_for(state="detached")
        expect(page).to_have_url(re.compile(f"/annotate/{FRAME}$"))
    page.unroute("**/label/object")
    problem.get_by_role("button", name="Try again").click()
    expect(problem).to_have_text("")
    bench.saved()
    assert len(bench.image_boxes) == 1
    # one whose class is removed is discarded, or gets another
    for kept in (False, True):
        change(edit.AddClass(name="cat"))
        for _ in ("its box", "itself"):
            page.keyboard.press("Escape")
        page.get_by_test_id("class-cat").click()
        _save_in_between(bench, lambda: change(edit.RemoveClass(name="cat", with_boxes=True)))
        bench.drag_on_image(2)
        expect(problem).to_contain_text("'cat' is not a class")
        expect(problem.get_by_test_id("save-as").locator("option")).to_have_text(["save it as …", "person"])
        if kept:
            problem.get_by_test_id("save-as").select_option("person")
        else:
            problem.get_by_role("button", name="Discard").click()
        expect(problem).to_have_text("")
        bench.saved()
        assert [box["label"] for box in bench.image_boxes] == ["person"] * (2 if kept else 1)
        expect(row).to_have_count(2 if kept else 1)


def test_a_finalised_frame_is_not_drawn_on_and_others_boxes_appear(bench: Bench) -> None:
    page, row = bench.page, bench.page.get_by_test_id("object")
    page.get_by_test_id("act-finalise").click()
    expect(page.get_by_test_id("image-note")).to_contain_text("finalised")
    drag_box(page, "image-editor", bench.scene.image_box(0), 320, 240)
    assert row.count() == 0
    page.keyboard.press("Control+Enter")
    expect(page.get_by_test_id("image-note")).not_to_contain_text("finalised")
    bench.saved()
    # another operator's boxes appear without a reload
    bench.other_saves(bench.scene.image_box(1))
    row.wait_for()
    bench.draw_on_image(0)
    bench.saved()
    assert len(bench.image_boxes) == 2
    with page.expect_response("**/label/steps") as answer:
        page.get_by_test_id("kind-box").click()
    assert answer.value.request.post_data_json["box_kind"] == "box"
    bench.saved()
    assert bench.state["image_boxes"]["box_kind"] == "box"
    # the choice is the project's, for all operators
    assert bench.live.client.get(bench.api).json()["settings"]["box_kind"] == "box"

    page.keyboard.press("?")
    table = page.get_by_test_id("key-table")
    expect(table.get_by_text("Accept, then go to the next")).to_have_count(1)
    page.keyboard.press("Escape")
    table.wait_for(state="detached")
    # the next frame is the one that teaches most
    page.get_by_test_id("queue-order").select_option("teach")
    expect(page.get_by_test_id("queue-item").first).to_be_visible()
    first = page.url
    page.keyboard.press("n")
    until(page, lambda: page.url != first)


def test_one_drag_and_space_make_a_label_and_detected_image_boxes_are_accepted(
    bench: Bench, knowing: Callable[..., Detectors], teach: Callable[..., None]
) -> None:
    perfect = knowing("people", kind=BoxKind.SILHOUETTE).view
    teach(name=pretrained.NAME, view=perfect)
    page = bench.page
    posts: list[str] = []

    def record(request: Request) -> None:
        if request.method == "POST":
            posts.append(request.url.rsplit("/", 1)[-1])

    page.on("request", record)
    drawn = bench.draw_on_image(0)
    dashed = page.locator(".views .box.suggested")
    expect(dashed).to_have_count(4)
    outline = page.get_by_test_id("image-editor").get_by_test_id("editor-overlay")
    expect(outline).to_have_count(1)
    expect(page.get_by_test_id("image-note")).to_contain_text("Space takes")
    expect(page.get_by_test_id("views-source")).to_contain_text(pretrained.TITLE)
    page.remove_listener("request", record)
    assert posts == ["object"], "one request a drag"
    assert bench.labels == []
    # said where the box would stand, too, and taken by the one button for it
    expect(page.get_by_test_id("box-advice")).to_contain_text("Space takes the dashed boxes")
    expect(page.get_by_role("button", name=re.compile("^Accept"))).to_have_count(1)
    page.keyboard.press("Space")
    row, box = page.get_by_test_id("object"), page.get_by_test_id("frame-box")
    expect(box).to_have_count(1)
    expect(dashed).to_have_count(0)
    bench.saved()
    (label,) = bench.labels
    assert label.suggestion == Suggestion(pretrained.TITLE, perfect.fingerprint)
    np.testing.assert_allclose(label.box.center_m, drawn["box"]["center"], atol=1e-9)
    assert iou_3d(label.box, bench.scene.objects[0].box) > 0.5
    assert bench.live.client.get(f"{bench.api}/statistics").json()["effort"]["actions_a_box"] == 2
    # undo returns to the dashed boxes, then to the empty image
    page.keyboard.press("Control+z")
    expect(dashed).to_have_count(4)
    expect(row).to_have_attribute("data-boxes", "1")
    assert bench.labels == []
    page.keyboard.press("Control+z")
    expect(row).to_have_count(0)
    page.keyboard.press("Control+Shift+z")
    page.keyboard.press("Control+Shift+z")
    expect(box).to_have_attribute("data-uid", label.uid)
    bench.saved()
    # the dashed boxes follow a corrected one
    page.keyboard.press("Escape")
    drawn = bench.draw_on_image(1)
    expect(dashed).to_have_count(4)
    (front, *_), (suggested, *_) = drawn["steps"][0]["views"], drawn["steps"][0]["suggested"]
    bench.wait_for_view(0, front)
    with page.expect_response(answers_drag(1)) as answer:
        bench.pull(0, (0.3, 1.0), (0.3, 0.5))  # the lower edge, to the middle
    following = answer.value.json()["drawn"]
    expect(dashed).to_have_count(3)
    bench.saved()
    assert following["box"]["size"][2] < 0.75 * drawn["box"]["size"][2]
    # a correction on the second step confirms the first one
    bench.wait_for_view(3, following["steps"][1]["views"][1])
    with page.expect_response(answers_drag(3)):
        bench.pull(3, (1.0, 0.3), (0.9, 0.3))
    expect(dashed).to_have_count(1)
    page.get_by_test_id("act-accept").click()
    expect(box).to_have_count(2)
    bench.saved()
    label = bench.labels[1]
    assert label.suggestion == Suggestion(pretrained.TITLE, perfect.fingerprint, corrected=True)
    stored = [box for _, box in bench.state["objects"][1]["views"]]
    assert abs(stored[0]["y_max"] - (suggested["y_min"] + suggested["y_max"]) / 2) < 3

    # an image detector suggests all objects of another frame
    people = knowing("people", kind=BoxKind.SILHOUETTE)
    teach(image=people.image, view=people.view)
    page.get_by_label("Next frame in time").click()
    suggested = page.get_by_test_id("image-editor").locator(".box.suggested")
    expect(suggested).to_have_count(3)
    expect(page.get_by_test_id("box-advice")).to_contain_text("Select a box, or draw one")
    page.keyboard.press("d")
    expect(page.get_by_test_id("box-advice")).to_contain_text("Click a dashed box")
    page.keyboard.press("d")
    with page.expect_response(answers_drag(0)):
        suggested.first.click(force=True)
    expect(dashed).to_have_count(4)
    page.keyboard.press("Space")
    expect(box).to_have_count(1)
    bench.saved()
    assert len(bench.project.labels.of_frame(FRAME + 1)) == 1
