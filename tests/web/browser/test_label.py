"""Label mode in a real browser: five drags per object, each saved at once."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Lock
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from browser_page import VIEWS, answers_drag, drag, drag_box, draw_on_views, sign_in, until
from drawing import Scene

from annotator.geometry.iou import iou_3d
from annotator.project import Project
from annotator.types import Box2D, BoxKind, DetectorKind, Label, ReviewState
from annotator.workflows.detectors import AGNOSTIC
from annotator.workflows.workbench.loaded_detectors import Readiness, ReadyDetector

expect = pytest.importorskip("playwright.sync_api").expect

if TYPE_CHECKING:
    from conftest import Shop
    from live_server import Live
    from playwright.sync_api import Page, Request

    from annotator.workflows.detectors import Detectors

FRAME = 1
EDGES = ("x_min", "y_min", "x_max", "y_max")


class TwoKinds:
    """A class-agnostic detector with a small box for the visible part, and a large one for the whole object."""

    labels, fingerprint = AGNOSTIC, "two kinds"

    def detect(self, images: Sequence[Any]) -> list[list[Box2D]]:
        found = []
        for image in images:
            height, width = image.rgb.shape[:2]
            found.append(
                [
                    Box2D(label, share * width, share * height, (1 - share) * width, (1 - share) * height, 0.9)
                    for label, share in zip(AGNOSTIC, (0.1, 0.3), strict=True)
                ]
            )
        return found


@dataclass(eq=False)
class Bench:
    """A page in Label mode, its project, and the true objects of its frame."""

    page: Page
    live: Live
    project: Project
    scene: Scene

    @property
    def api(self) -> str:
        """The URL path of the project's API."""
        return f"/api/projects/{self.project.path.name}"

    @property
    def labels(self) -> list[Label]:
        return list(self.project.labels.of_frame(FRAME))

    @property
    def image_boxes(self) -> list[dict[str, float]]:
        known = self.state["image_boxes"]
        return [] if known is None else known["boxes"]

    @property
    def state(self) -> dict[str, Any]:
        return self.live.client.get(f"{self.api}/frames/{FRAME}").json()

    @property
    def hint(self) -> str:
        return self.page.get_by_test_id("hint").inner_text()

    def saved(self) -> None:
        """Waits until all changes are saved."""
        self.page.wait_for_selector(".label-mode:not([data-saving])")
        assert self.page.get_by_test_id("save-problem").inner_text() == ""

    def draw_on_image(self, number: int) -> dict[str, Any]:
        """Draws the image box of a true object; returns the answer's views and suggestions."""
        with self.page.expect_response(answers_drag(0)) as answer:
            self.drag_on_image(number)
        drawn: dict[str, Any] = answer.value.json().get("drawn", {})
        return drawn

    def drag_on_image(self, number: int) -> None:
        camera = self.scene.frame.camera
        drag_box(self.page, "image-editor", self.scene.image_box(number), camera.width_px, camera.height_px)

    def draw_on_view(self, place: int, view: dict[str, Any], box: dict[str, Any]) -> None:
        """Draws a box on one of the four views."""
        drag_box(self.page, f"view-{VIEWS[place]}", box, view["width"], view["height"])

    def wait_for_view(self, place: int, view: dict[str, Any]) -> None:
        pane = self.page.get_by_test_id(f"view-{VIEWS[place]}")
        pane.locator(f'img.picture[src="{view["url"]}"]').wait_for(state="attached")

    def pull(self, place: int, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Drags the dashed box of a view; both points are shares of its width and height."""
        # in one call, because the editor may draw the box again in between
        find = "(pane) => pane.querySelector('.box.suggested rect.line').getBoundingClientRect().toJSON()"
        shown = self.page.get_by_test_id(f"view-{VIEWS[place]}").evaluate(find)
        corner, size = np.array([shown["x"], shown["y"]]), np.array([shown["width"], shown["height"]])
        drag(self.page, tuple(corner + start * size), tuple(corner + end * size))

    def draw_object(self, number: int) -> None:
        """Draws all five boxes of a true object."""
        first = self.draw_on_image(number)
        with self.page.expect_response(answers_drag(2)) as answer:
            draw_on_views(self.page, self.scene, number, first["steps"][0]["views"])
        draw_on_views(self.page, self.scene, number, answer.value.json()["drawn"]["steps"][1]["views"], step=1)
        self.saved()

    def other_saves(self, box: dict[str, Any]) -> None:
        """Another operator adds a box to the image."""
        state = self.state
        boxes = [*([] if state["image_boxes"] is None else state["image_boxes"]["boxes"]), box]
        changes = [{"kind": "image_boxes", "boxes": boxes, "box_kind": "silhouette"}]
        body = {"revision": state["frame"]["revision"], "changes": changes}
        answer = self.live.client.post(f"{self.api}/frames/{FRAME}/changes", json=body)
        assert answer.status_code == 200, answer.text


@pytest.fixture
def bench(shared_page: Page, shop: Shop, generated: Path) -> Bench:
    """Label mode on a frame without labels, without the 3D view; `live.client` is another operator."""
    project = shop.new_project()
    sign_in(shared_page, shop.live.url, "Bob")
    shared_page.goto(f"/#/{project.path.name}/label/{FRAME}")
    shown = f"img.picture[src*='/{project.path.name}/frames/{FRAME}/']"
    shared_page.get_by_test_id("image-editor").locator(shown).wait_for()
    return Bench(shared_page, shop.live, project, Scene.of(generated / "people", 0, ("person",)))


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


def test_a_whole_box_is_offered_and_enter_confirms_it(bench: Bench) -> None:
    bench.draw_object(0)
    page, (seen,) = bench.page, bench.labels
    assert seen.box_kind is BoxKind.SILHOUETTE
    whole_box = page.locator("[data-testid=image-editor] [data-testid=editor-overlay][data-id=whole]")
    hint = page.get_by_test_id("hint")
    expect(whole_box).to_have_count(1)
    expect(hint).to_contain_text("Enter confirms the dashed box as the whole person")
    # nothing is stored until the operator confirms one
    assert bench.labels[0].box_kind is BoxKind.SILHOUETTE
    dashed = whole_box.locator("path.halo")
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
    problem.get_by_role("button").wait_for()
    assert bench.state == before
    expect(page.locator(".views img.picture[src]")).to_have_count(0)
    page.unroute("**/label/steps")
    problem.get_by_role("button").click()
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
    problem.get_by_role("button").wait_for()
    assert bench.image_boxes == []
    assert bench.page.evaluate("!dispatchEvent(new Event('beforeunload', { cancelable: true }))")
    for leave in (lambda: bench.page.keyboard.press("n"), bench.page.get_by_test_id("mode-review").click):
        leave()
        bench.page.get_by_test_id("unsaved-dialog").wait_for()
        bench.page.get_by_test_id("dialog-stay").click()
        bench.page.get_by_test_id("unsaved-dialog").wait_for(state="detached")
        expect(bench.page).to_have_url(re.compile(f"/label/{FRAME}$"))
    bench.page.unroute("**/label/object")
    problem.get_by_role("button").click()
    expect(problem).to_have_text("")
    bench.saved()
    assert len(bench.image_boxes) == 1


@pytest.fixture
def teach(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """`teach(image=..., view=...)`: gives the project detectors, and reloads the page."""

    def taught(class_agnostic: bool = False, **detectors: Any) -> None:
        ready = {
            DetectorKind(role): Readiness("ready", ReadyDetector(detector, BoxKind.SILHOUETTE, Lock(), class_agnostic))
            for role, detector in detectors.items()
        }
        look = lambda project, role, wait_s=None: ready.get(role, Readiness("none"))  # noqa: E731
        monkeypatch.setattr(bench.live.context.caches.detectors, "readiness", look)
        info = bench.live.client.get(bench.api).json()
        models = {role: {"id": 1} if role in detectors else None for role in ("image", "view")}
        bench.page.route(f"**{bench.api}", lambda route: route.fulfill(json={**info, "detectors": models}))
        bench.page.reload()
        bench.page.get_by_test_id("image-editor").locator("img.picture[src]").wait_for()

    return taught


def test_another_kind_of_boxes_brings_its_own_suggestions(bench: Bench, teach: Callable[..., None]) -> None:
    teach(class_agnostic=True, view=TwoKinds())
    page = bench.page
    first = bench.draw_on_image(0)["steps"][0]["suggested"]
    dashed = page.locator(".views .box.suggested")
    expect(dashed.first).to_be_visible()
    bench.saved()
    answers = Event()

    def hold(route: Any) -> None:
        # Enter must not take the old suggestions meanwhile
        page.keyboard.press("Enter")
        answers.set()
        route.continue_()

    page.route("**/label/steps", hold)
    with page.expect_response("**/label/steps") as answer:
        page.keyboard.press("b")
    second = answer.value.json()["steps"][0]["suggested"]
    assert answers.is_set()
    assert bench.labels == []
    assert answer.value.request.post_data_json["box_kind"] == "box"
    edges = [[[box[edge] for edge in EDGES] for box in boxes] for boxes in (first, second)]
    assert edges[0] != edges[1]
    expect(page.get_by_test_id("object")).to_have_attribute("data-boxes", "1")
    bench.saved()
    assert bench.state["image_boxes"]["box_kind"] == "box"


def test_one_drag_and_enter_make_a_label(
    bench: Bench, knowing: Callable[..., Detectors], teach: Callable[..., None]
) -> None:
    teach(view=knowing("people", kind=BoxKind.SILHOUETTE).view)
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
    hint = page.get_by_test_id("hint")
    expect(hint).to_contain_text("Enter accepts")
    assert hint.evaluate("e => e.scrollHeight <= e.clientHeight + 1 && e.scrollWidth <= e.clientWidth"), "it is not cut"
    expect(page.get_by_test_id("views-source")).to_contain_text("this project's view detector")
    page.remove_listener("request", record)
    assert posts == ["object"], "one request a drag"
    assert bench.labels == []
    page.keyboard.press("Enter")
    expect(page.get_by_test_id("object")).to_have_attribute("data-boxes", "5")
    expect(dashed).to_have_count(0)
    bench.saved()
    (label,) = bench.labels
    np.testing.assert_allclose(label.box.center_m, drawn["box"]["center"], atol=1e-9)
    assert iou_3d(label.box, bench.scene.objects[0].box) > 0.5
    assert bench.live.client.get(f"{bench.api}/statistics").json()["effort"]["actions_a_box"] == 2
    # undo returns to the dashed boxes, then to the empty image
    page.keyboard.press("Control+z")
    expect(dashed).to_have_count(4)
    expect(page.get_by_test_id("object")).to_have_attribute("data-boxes", "1")
    assert bench.labels == []
    page.keyboard.press("Control+z")
    expect(page.get_by_test_id("object")).to_have_count(0)
    page.keyboard.press("Control+Shift+z")
    page.keyboard.press("Control+Shift+z")
    expect(page.get_by_test_id("object")).to_have_attribute("data-uid", label.uid)


def test_the_dashed_boxes_follow_a_corrected_one(
    bench: Bench, knowing: Callable[..., Detectors], teach: Callable[..., None]
) -> None:
    teach(view=knowing("people", kind=BoxKind.SILHOUETTE).view)
    page = bench.page
    drawn = bench.draw_on_image(0)
    dashed = page.locator(".views .box.suggested")
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
    page.get_by_test_id("accept-all").click()
    expect(page.get_by_test_id("object")).to_have_attribute("data-boxes", "5")
    bench.saved()
    assert len(bench.labels) == 1
    stored = [box for _, box in bench.state["objects"][0]["views"]]
    assert abs(stored[0]["y_max"] - (suggested["y_min"] + suggested["y_max"]) / 2) < 3
    # after a reload, the box that is left is on its view again
    page.keyboard.press("Control+z")
    expect(page.get_by_test_id("object")).to_have_attribute("data-boxes", "4")
    expect(dashed).to_have_count(1)


def test_detected_image_boxes_are_accepted_with_enter(
    bench: Bench, knowing: Callable[..., Detectors], teach: Callable[..., None]
) -> None:
    perfect = knowing("people", kind=BoxKind.SILHOUETTE)
    teach(image=perfect.image, view=perfect.view)
    expect(bench.page.get_by_test_id("image-editor").locator(".box.suggested")).to_have_count(3)
    bench.page.keyboard.press("Enter")
    expect(bench.page.locator(".views .box.suggested")).to_have_count(4)
    bench.page.keyboard.press("Enter")
    expect(bench.page.get_by_test_id("object")).to_have_attribute("data-boxes", "5")
    bench.saved()
    assert len(bench.labels) == 1


class BlockedDetector:
    """A detector that blocks until `may_answer` is set."""

    labels = ("person",)
    fingerprint = "blocked"

    def __init__(self, detector: Any) -> None:
        self.detector = detector
        self.may_answer = Event()

    def detect(self, images: Any) -> Any:
        assert self.may_answer.wait(60)
        return self.detector.detect(images)


@pytest.fixture
def blocked(bench: Bench, knowing: Callable[..., Detectors], teach: Callable[..., None]) -> Iterator[BlockedDetector]:
    """A view detector of the project that is still blocked."""
    detector = BlockedDetector(knowing("people", kind=BoxKind.SILHOUETTE).view)
    teach(view=detector)
    yield detector
    detector.may_answer.set()


def test_a_box_drawn_while_the_detector_runs_is_kept(bench: Bench, blocked: BlockedDetector) -> None:
    blocked.may_answer.set()
    drawn = bench.draw_on_image(0)
    views = drawn["steps"][0]["views"]
    dashed = bench.page.locator(".views .box.suggested")
    expect(dashed).to_have_count(4)
    blocked.may_answer.clear()
    # two drags before the first is answered
    before = [(views[place], box) for place, box in enumerate(drawn["steps"][0]["suggested"])]
    for place, (view, _) in enumerate(before):
        bench.wait_for_view(place, view)
        bench.pull(place, (0.5, 0.3), (0.4, 0.3))
    expect(bench.page.get_by_test_id("hint")).to_contain_text("Looking for")
    blocked.may_answer.set()
    expect(dashed).to_have_count(2)
    bench.saved()
    for (_, kept), (_, box) in zip(bench.state["objects"][0]["views"], before, strict=True):
        assert kept["x_min"] < box["x_min"] - 1 and abs(kept["y_min"] - box["y_min"]) < 2


def test_a_deleted_view_box_is_suggested_again(
    bench: Bench, knowing: Callable[..., Detectors], teach: Callable[..., None]
) -> None:
    teach(view=knowing("people", kind=BoxKind.SILHOUETTE).view)
    bench.draw_on_image(0)
    dashed = bench.page.locator(".views .box.suggested")
    expect(dashed).to_have_count(4)
    bench.page.keyboard.press("Enter")
    expect(bench.page.get_by_test_id("object")).to_have_attribute("data-boxes", "5")
    bench.page.get_by_test_id("view-side-2").get_by_test_id("editor2d").focus()
    bench.page.keyboard.press("Delete")
    expect(dashed).to_have_count(1)
    expect(bench.page.get_by_test_id("object")).to_have_attribute("data-boxes", "4")
    bench.saved()


def test_a_detector_that_cannot_be_loaded_is_reported_once(bench: Bench, tmp_path: Path) -> None:
    weights = tmp_path / "broken" / "best.pt"
    weights.parent.mkdir()
    weights.write_bytes(b"no weights")
    bench.project.models.register(
        DetectorKind.VIEW, weights, labels=["person"], box_kind=BoxKind.BOX, metrics={}, fingerprint="broken"
    )
    bench.draw_on_image(0)
    told = bench.page.get_by_test_id("toast-warn").filter(has_text="the view detector cannot be loaded")
    expect(told).to_have_count(1)
    told.get_by_role("button").click()
    views = bench.draw_on_image(1)["steps"][0]["views"]
    bench.wait_for_view(1, views[1])
    bench.saved()
    expect(told).to_have_count(0)


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
