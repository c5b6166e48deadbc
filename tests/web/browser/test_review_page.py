"""Review in a real browser: one key for a right proposal, and every way to mend a wrong one."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from browser_page import drag, drag_box, seen_by_viewer, sign_in
from drawing import Scene
from scipy.spatial.transform import Rotation

from annotator.geometry.outline import box_on_image
from annotator.project import Change, Project
from annotator.recordings import open_recording
from annotator.types import BoxKind, Label, OrientedBox, Proposal, Quality, ReviewState, Source
from annotator.types.errors import FrameError
from annotator.workflows.detectors_ready import Readiness, ReadyDetector
from annotator.workflows.truth import load_truth

if TYPE_CHECKING:
    from conftest import Shop
    from live_server import Live
    from playwright.sync_api import Locator, Page

    from annotator.workflows.detectors import Detectors

expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect

FRAMES = 3


@dataclass(eq=False)
class Desk:
    """A page in Review, and the project behind it."""

    page: Page
    live: Live
    project: Project

    @property
    def name(self) -> str:
        """The project's name."""
        return self.project.path.name

    @property
    def api(self) -> str:
        """Where the project is."""
        return f"/api/projects/{self.name}"

    @property
    def frame(self) -> int:
        """The frame that the page shows."""
        return int(self.page.url.split("/review/")[1].split("?")[0])

    @property
    def uid(self) -> str:
        """The label that is selected."""
        row = self.page.locator('[data-testid="frame-box"][aria-current="true"]')
        found = row.get_attribute("data-uid")
        assert found is not None
        return found

    @property
    def label(self) -> Label:
        """The selected label as it is stored."""
        return self.project.labels.get(self.uid).label

    def box(self, view: str) -> Locator:
        """The rectangle of the selected box in one of the views along its axes."""
        return self.page.get_by_test_id(f"ortho-{view}").locator("rect.line")

    def settled(self) -> None:
        """All is saved, and the three views show the box as it is."""
        expect(self.page.get_by_test_id("saving")).to_have_text("")
        expect(self.page.locator('[data-testid="orthos"][data-shown]:not([data-shown=""])')).to_be_visible()
        for view in ("top", "front", "side"):
            self.box(view).wait_for()

    def press(self, *keys: str) -> None:
        for key in keys:
            self.page.keyboard.press(key)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        between = [start[i] + np.outer((0.25, 0.5, 0.75, 1.0), (end[i] - start[i])).ravel() for i in (0, 1)]
        drag(self.page, start, *zip(*between, strict=True))


def propose(project: Project, recording: Path, frames: int = FRAMES) -> None:
    """Proposals near the truth, one a true object: the more doubtful, the further off."""
    opened = open_recording(recording)
    rng = np.random.default_rng(5)
    for index, stored in enumerate(project.frames.of()[:frames]):
        frame = opened.frame(index)
        proposals = []
        for truth in load_truth(opened, index, frame):
            off = rng.uniform(0.2, 1.0)
            turn = Rotation.from_rotvec(rng.normal(0, 0.05 * off, 3)).as_matrix() @ truth.box.rotation
            box = OrientedBox.from_parts(truth.box.center_m + rng.normal(0, 0.03 * off, 3), turn, truth.box.size_m)
            image_box = box_on_image(frame.camera, box, truth.label)
            if image_box is not None:
                proposals.append(Proposal(truth.label, 1 - off / 2, box, image_box, (), Quality(off / 3, 0.9, off / 9)))
        project.proposals.replace(stored.id, proposals, Change(stored.revision, "detectors", Source.AUTO))


@pytest.fixture
def desk(shared_page: Page, shop: Shop) -> Desk:
    """A signed-in operator in Review of a project with proposals; the worst one is selected. Without the 3D view."""
    return begin(shared_page, shop)


@pytest.fixture
def desk_3d(shared_page_3d: Page, shop: Shop) -> Desk:
    """The same with the 3D view."""
    desk = begin(shared_page_3d, shop)
    expect(desk.page.get_by_test_id("viewport")).to_have_attribute("data-state", "ready", timeout=40_000)
    return desk


def begin(page: Page, shop: Shop) -> Desk:
    project = shop.new_project()
    propose(project, shop.recording)
    sign_in(page, shop.live.url)
    page.goto(f"/#/{project.path.name}/review")
    desk = Desk(page, shop.live, project)
    page.locator(f"[data-testid=review-image] img.picture[src*='/{desk.name}/']").wait_for()
    desk.settled()
    return desk


def middle(element: Locator) -> tuple[float, float]:
    box = element.bounding_box()
    assert box is not None
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def test_one_key_accepts_a_right_proposal_and_counts_one_action(desk: Desk, wait_for) -> None:
    first, items = desk.uid, desk.page.get_by_test_id("queue-item").count()
    desk.press("Space")
    wait_for(lambda: desk.project.labels.get(first).label.state is ReviewState.ACCEPTED, 5)
    expect(desk.page.get_by_test_id("queue-item")).to_have_count(items - 1)
    desk.settled()
    assert desk.uid != first
    assert desk.project.labels.get(first).label.author == "Ada"
    statistics = desk.live.client.get(f"{desk.api}/statistics").json()
    assert statistics["effort"]["actions_a_box"] == 1
    assert statistics["accepted_untouched"] == 1


def test_the_queue_is_worked_off_with_one_key_a_proposal(desk: Desk, wait_for) -> None:
    items = desk.page.get_by_test_id("queue-item").count()
    assert items >= 2 * FRAMES
    for left in range(items - 1, -1, -1):
        desk.press("Space")
        expect(desk.page.get_by_test_id("queue-item")).to_have_count(left)
        desk.settled()
    desk.page.get_by_test_id("review-done").wait_for()
    labels = desk.project.labels.select()
    assert {stored.label.state for stored in labels} == {ReviewState.ACCEPTED}
    assert desk.live.client.get(f"{desk.api}/statistics").json()["effort"]["actions_a_box"] == 1


@pytest.mark.parametrize("view", ["top", "front", "side"])
def test_a_dragged_edge_moves_one_face_by_as_many_metres(desk: Desk, wait_for, view: str) -> None:
    before = desk.label.box
    rect = desk.box(view).bounding_box()
    assert rect is not None
    pull = 31.0
    right = (rect["x"] + rect["width"], rect["y"] + rect["height"] / 2)
    desk.drag((right[0] - 1, right[1]), (right[0] - 1 + pull, right[1]))
    wait_for(lambda: desk.label.state is ReviewState.EDITED, 5)
    after = desk.label.box
    changed = np.flatnonzero(np.abs(after.size_m - before.size_m) > 1e-9)
    assert len(changed) == 1
    side = int(changed[0])
    px_m = before.size_m[side] / (rect["width"] - 2)  # the line around the box is 2 px wide
    assert after.size_m[side] - before.size_m[side] == pytest.approx(pull * px_m, rel=0.02)
    # the face on the other side stayed where it was
    shift = before.rotation.T @ (after.center_m - before.center_m)
    assert abs(shift[side]) == pytest.approx((after.size_m[side] - before.size_m[side]) / 2, abs=1e-6)
    assert np.abs(np.delete(shift, side)).max() < 1e-6
    np.testing.assert_allclose(after.rotation, before.rotation, atol=1e-6)


def test_while_an_edge_is_dragged_nothing_is_asked_and_all_pictures_follow(desk: Desk) -> None:
    page = desk.page
    rect = desk.box("top").bounding_box()
    assert rect is not None
    start = (rect["x"] + rect["width"] - 1, rect["y"] + rect["height"] / 2)
    image = page.get_by_test_id("editor-overlay")
    lines = image.evaluate_all("found => found.map((one) => one.innerHTML)")
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url) if "/api/projects/" in request.url else None)
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(start[0] + 20, start[1], steps=4)
    page.wait_for_timeout(150)
    assert asked == []
    assert image.evaluate_all("found => found.map((one) => one.innerHTML)") != lines
    assert "not saved" in page.get_by_test_id("label-state").inner_text()
    page.keyboard.press("Escape")
    page.mouse.up()
    desk.settled()
    assert page.get_by_test_id("label-state").inner_text() == "proposed"
    assert desk.label.state is ReviewState.PROPOSED


def test_arrow_keys_move_the_box_of_the_focused_view_as_one_edit(desk: Desk, wait_for) -> None:
    before, revision = desk.label.box, desk.project.frames.get(desk.frame).revision
    with desk.page.expect_response(lambda response: response.url.endswith("/ortho")) as answer:
        desk.page.reload()
    desk.settled()
    front = next(view for view in answer.value.json()["views"] if view["name"] == "front")
    desk.page.mouse.click(*middle(desk.box("front")))
    desk.press("ArrowRight", "ArrowRight", "ArrowRight")
    wait_for(lambda: desk.label.state is ReviewState.EDITED, 5)
    shift = np.array(front["axes"]) @ (desk.label.box.center_m - before.center_m)
    np.testing.assert_allclose(shift, [3 * front["metres_per_px"], 0, 0], atol=1e-6)
    assert desk.project.frames.get(desk.frame).revision == revision + 1


def test_the_rotation_handle_turns_the_box_about_its_centre(desk: Desk, wait_for) -> None:
    before = desk.label.box
    handle = middle(desk.page.get_by_test_id("ortho-top").get_by_test_id("rotate-handle"))
    center = middle(desk.box("top"))
    angle = np.radians(30)
    arm = np.subtract(handle, center)
    turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ arm
    desk.drag(handle, (center[0] + turned[0], center[1] + turned[1]))
    wait_for(lambda: desk.label.state is ReviewState.EDITED, 5)
    after = desk.label.box
    turn = Rotation.from_matrix(before.rotation.T @ after.rotation).as_rotvec()
    assert np.linalg.norm(turn) == pytest.approx(angle, abs=np.radians(1.5))
    assert abs(turn[2]) == pytest.approx(np.linalg.norm(turn), rel=1e-3)  # seen from the top: about the box's own z
    np.testing.assert_allclose(after.center_m, before.center_m, atol=1e-6)
    np.testing.assert_allclose(after.size_m, before.size_m, atol=1e-9)
    desk.settled()  # new pictures, along the new axes: the box is a rectangle again


def test_an_edit_is_undone_and_done_again(desk: Desk, wait_for) -> None:
    before, uid = desk.label.box, desk.uid
    desk.press("f")
    wait_for(lambda: desk.label.state is ReviewState.EDITED, 5)
    turned = desk.label.box
    desk.settled()
    desk.press("Control+z")
    wait_for(lambda: desk.project.labels.get(uid).label.state is ReviewState.PROPOSED, 5)
    np.testing.assert_array_equal(desk.project.labels.get(uid).label.box.size_m, before.size_m)
    desk.settled()
    desk.press("Control+Shift+z")
    wait_for(lambda: desk.project.labels.get(uid).label.state is ReviewState.EDITED, 5)
    np.testing.assert_array_equal(desk.project.labels.get(uid).label.box.size_m, turned.size_m)


def test_the_heading_turns_by_90_degrees_and_the_body_stays(desk: Desk, wait_for) -> None:
    before = desk.label.box
    desk.press("f")
    wait_for(lambda: desk.label.state is ReviewState.EDITED, 5)
    after = desk.label.box
    np.testing.assert_allclose(after.size_m, before.size_m[[1, 0, 2]], atol=1e-9)
    np.testing.assert_allclose(after.rotation[:, 0], before.rotation[:, 1], atol=1e-9)
    np.testing.assert_allclose(after.center_m, before.center_m, atol=1e-9)


def test_numbers_change_the_box_and_are_saved_once(desk: Desk, wait_for) -> None:
    before, revision = desk.label.box, desk.project.frames.get(desk.frame).revision
    field = desk.page.get_by_test_id("field-size-length")
    field.fill("1.25")
    assert "not saved" in desk.page.get_by_test_id("label-state").inner_text()
    field.press("Enter")
    wait_for(lambda: desk.label.state is ReviewState.EDITED, 5)
    assert desk.label.box.size_m[0] == pytest.approx(1.25)
    assert desk.project.frames.get(desk.frame).revision == revision + 1
    desk.settled()
    yaw = desk.page.get_by_test_id("field-yaw")
    wanted = float(yaw.input_value()) + 20
    yaw.fill(f"{wanted:.1f}")
    yaw.press("Tab")
    wait_for(lambda: desk.project.frames.get(desk.frame).revision == revision + 2, 5)
    turn = Rotation.from_matrix(before.rotation.T @ desk.label.box.rotation).magnitude()
    assert np.degrees(turn) == pytest.approx(20, abs=0.2)


def test_escape_takes_back_a_number_that_is_not_saved(desk: Desk) -> None:
    field = desk.page.get_by_test_id("field-center-x")
    was = field.input_value()
    field.fill("9.5")
    field.press("Escape")
    assert field.input_value() == was
    assert desk.label.state is ReviewState.PROPOSED


def test_keys_work_when_the_focus_is_in_the_3d_view(desk_3d: Desk, wait_for) -> None:
    desk, page = desk_3d, desk_3d.page
    first = desk.uid
    where = page.get_by_test_id("viewport").bounding_box()
    assert where is not None
    page.mouse.click(where["x"] + 8, where["y"] + where["height"] - 8)
    page.get_by_test_id("viewport-frame").content_frame.locator("body").evaluate("body => window.focus()")
    desk.press("Space")
    wait_for(lambda: desk.project.labels.get(first).label.state is ReviewState.ACCEPTED, 5)


def test_the_gizmo_moves_the_box_along_its_axis_and_saves_it_when_it_is_let_go(desk_3d: Desk, wait_for) -> None:
    desk, page = desk_3d, desk_3d.page
    with page.expect_response(lambda response: '"gizmo":"translate"' in (response.request.post_data or "")) as answer:
        desk.press("t")
    expect(page.get_by_test_id("gizmo-translate")).to_have_attribute("aria-pressed", "true")
    bench = desk.live.server.app.state.workbenches.get(answer.value.url.split("/")[-2], "Ada")
    node = bench._server.scene.get_handle_by_name("/selected")
    rect = page.get_by_test_id("viewport").bounding_box()
    assert rect is not None
    box, uid = desk.label.box, desk.uid
    page.wait_for_timeout(1000)  # the gizmo is on the screen

    def on_axis(axis: int, share: float) -> tuple[float, float]:
        return seen_by_viewer(bench, rect, box.center_m + share * node.scale * box.rotation[:, axis])

    # of the three arrows the one that is seen longest: taken at its middle, and pulled outwards
    lengths = [np.linalg.norm(np.subtract(on_axis(axis, 1.0), on_axis(axis, 0.0))) for axis in range(3)]
    axis = int(np.argmax(lengths))
    start, end = on_axis(axis, 0.6), on_axis(axis, 1.0)
    page.mouse.move(*start)
    page.wait_for_timeout(300)
    page.mouse.down()
    page.mouse.move(*end, steps=8)
    expect(page.get_by_test_id("label-state")).to_have_text("not saved")
    assert desk.label.state is ReviewState.PROPOSED
    page.mouse.up()
    wait_for(lambda: desk.project.labels.get(uid).label.state is ReviewState.EDITED, 10)
    after = desk.project.labels.get(uid).label.box
    moved = after.center_m - box.center_m
    assert np.linalg.norm(moved) > 0.05
    np.testing.assert_allclose(moved / np.linalg.norm(moved), box.rotation[:, axis], atol=2e-3)
    np.testing.assert_allclose(after.size_m, box.size_m, atol=1e-9)
    np.testing.assert_allclose(after.rotation, box.rotation, atol=1e-6)


def test_reject_delete_tab_and_the_class_by_a_digit(desk: Desk, wait_for) -> None:
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
    wait_for(lambda: desk.label.label == "chair", 5)
    desk.settled()
    second = uids[(uids.index(first) + 1) % len(uids)]
    desk.press("Tab", "x")
    wait_for(lambda: desk.project.labels.get(str(second)).label.state is ReviewState.REJECTED, 5)
    desk.settled()
    gone = desk.uid
    frame = desk.frame
    desk.press("Delete")
    wait_for(lambda: gone not in {label.uid for label in desk.project.labels.of_frame(frame)}, 5)


def test_frames_are_stepped_through_and_finalised(desk: Desk, wait_for) -> None:
    frames = [stored.id for stored in desk.project.frames.of()]
    desk.page.goto(f"/#/{desk.name}/review/{frames[0]}")
    expect(desk.page.get_by_test_id("frame-position")).to_have_text("1 / 5")
    desk.press("n")
    expect(desk.page.get_by_test_id("frame-position")).to_have_text("2 / 5")
    assert desk.frame == frames[1]
    desk.press("p")
    expect(desk.page.get_by_test_id("frame-position")).to_have_text("1 / 5")
    desk.press("Control+Enter")
    desk.page.get_by_test_id("dialog-yes").click()
    wait_for(lambda: desk.project.frames.get(frames[0]).finalised, 5)
    expect(desk.page.get_by_test_id("act-finalise")).to_have_text("Reopen frame")
    desk.page.get_by_test_id("act-finalise").click()
    wait_for(lambda: not desk.project.frames.get(frames[0]).finalised, 5)


def test_reviewed_boxes_are_copied_from_the_previous_frame(desk: Desk, wait_for) -> None:
    frames = [stored.id for stored in desk.project.frames.of()]
    for label in desk.project.labels.of_frame(frames[FRAMES - 1]):
        change = Change(desk.project.frames.get(frames[FRAMES - 1]).revision, "Bob")
        desk.project.labels.accept(frames[FRAMES - 1], label.uid, change)
    before = desk.project.labels.of_frame(frames[FRAMES - 1])
    desk.page.goto(f"/#/{desk.name}/review/{frames[FRAMES]}")
    desk.page.get_by_test_id("frame-summary").get_by_text("0 boxes").wait_for()
    desk.press("c")
    wait_for(lambda: len(desk.project.labels.of_frame(frames[FRAMES])) == len(before), 5)


def test_fitting_again_starts_from_the_box(desk: Desk, wait_for) -> None:
    frame, label = desk.frame, desk.label
    off = OrientedBox.from_parts(label.box.center_m + np.array([0.15, 0, 0]), label.box.rotation, label.box.size_m)
    change = Change(desk.project.frames.get(frame).revision, "Bob")
    desk.project.labels.edit(frame, label.uid, change, label=label.label, box=off)
    desk.page.reload()
    desk.page.locator(f'[data-testid="frame-box"][data-uid="{label.uid}"]').click()
    desk.settled()
    with desk.page.expect_response(lambda response: response.url.endswith("/refit")) as answer:
        desk.press("g")
    assert answer.value.ok
    fitted = np.array(answer.value.json()["box"]["center"])
    wait_for(lambda: np.abs(desk.label.box.center_m - fitted).max() < 1e-6, 5)


def test_a_box_is_selected_by_a_click_on_the_image_or_in_the_list(desk: Desk) -> None:
    page = desk.page
    other = page.locator('[data-testid="frame-box"]:not([aria-current="true"])').first
    uid = other.get_attribute("data-uid")
    other.click()
    assert desk.uid == uid
    desk.settled()
    page.keyboard.press("Escape")
    expect(page.locator('[data-testid="frame-box"][aria-current="true"]')).to_have_count(0)
    # pictures are drawn anew with the next frame of the screen, so what is found now may be gone in a moment
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


def test_what_another_operator_does_is_seen_at_once(desk: Desk) -> None:
    frame, uid = desk.frame, desk.uid
    revision = desk.project.frames.get(frame).revision
    body = {"revision": revision, "changes": [{"kind": "reject", "uid": uid}], "effort": None, "subject": None}
    answer = desk.live.client.post(f"{desk.api}/frames/{frame}/changes", json=body)
    assert answer.status_code == 200
    row = desk.page.locator(f'[data-testid="frame-box"][data-uid="{uid}"][data-state="rejected"]')
    row.wait_for(timeout=2000)


def draw_on_image(desk: Desk, box: dict[str, Any]) -> None:
    """Presses B and drags a box on the image."""
    desk.press("b")
    expect(desk.page.get_by_test_id("act-draw")).to_have_attribute("aria-pressed", "true")
    drag_box(desk.page, "review-image", box, 320, 240)


def test_a_new_box_is_drawn_on_the_image(
    desk: Desk, generated: Path, knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch, wait_for
) -> None:
    page, known = desk.page, {stored.label.uid for stored in desk.project.labels.select()}
    ready = Readiness("ready", ReadyDetector(knowing("people", kind=BoxKind.BOX).view, BoxKind.BOX, Lock()))
    detectors = desk.live.context.annotation.detectors
    monkeypatch.setattr(detectors, "look", lambda project, role, wait_s=None: ready)
    index = desk.project.frames.get(desk.frame).index
    assert index is not None
    scene = Scene.of(generated / "people", index, ("person",))
    draw_on_image(desk, scene.image_box(0))
    expect(page.get_by_test_id("label-state")).to_have_text("new")
    desk.settled()
    desk.press("t")  # gizmo and views work on it as on any other box
    field = page.get_by_test_id("field-size-length")
    field.fill("0.9")
    field.press("Enter")
    assert {stored.label.uid for stored in desk.project.labels.select()} == known
    desk.press("n")  # nobody has accepted it: it is not left behind without a word
    expect(page.get_by_test_id("unsaved-dialog")).to_contain_text("1 new box that nobody has accepted")
    page.get_by_test_id("dialog-stay").click()
    page.locator("dialog").wait_for(state="detached")
    desk.press("Space")
    wait_for(lambda: len(desk.project.labels.select()) == len(known) + 1, 5)
    (made,) = (stored for stored in desk.project.labels.select() if stored.label.uid not in known)
    assert made.label.state is ReviewState.ACCEPTED and made.image_box is not None
    assert made.label.box.size_m[0] == pytest.approx(0.9)
    assert np.linalg.norm(made.label.box.center_m - scene.objects[0].box.center_m) < 0.1
    statistics = desk.live.client.get(f"{desk.api}/statistics").json()
    assert statistics["effort"]["by_origin"]["from nothing"]["actions_a_box"] == 3  # the drag, the number, Space

    # without a detector, Label goes on with it
    monkeypatch.setattr(detectors, "look", lambda project, role, wait_s=None: Readiness("none"))
    desk.settled()
    frame = desk.frame
    draw_on_image(desk, scene.image_box(1))
    expect(page).to_have_url(re.compile(f"/label/{frame}$"))
    expect(page.get_by_test_id("toast-warn")).to_contain_text("There is no pseudo-view detector yet")
    expect(page.get_by_test_id("object")).to_have_attribute("data-boxes", "1")
    page.wait_for_selector(".label-mode:not([data-saving])")
    state = desk.live.client.get(f"{desk.api}/frames/{frame}").json()
    assert [len(drawn["views"]) for drawn in state["objects"]] == [0]
    (kept,) = state["image_boxes"]["boxes"]
    assert all(abs(kept[edge] - scene.image_box(1)[edge]) < 0.6 for edge in ("x_min", "y_min", "x_max", "y_max"))


def test_a_frame_that_cannot_be_read_says_so_in_place_of_its_picture(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    page, frames = desk.page, desk.live.context.annotation.frames
    page.evaluate("localStorage.setItem('label-order', 'time')")
    first, second, third = (stored.id for stored in desk.project.frames.of()[:3])
    truncated = FrameError(Path("people/depth/000001.png"), "the file is truncated", "copy it again")
    read = frames.open

    def broken(project: Project, frame_id: int) -> Any:
        if frame_id == second:
            raise truncated
        return read(project, frame_id)

    monkeypatch.setattr(frames, "open", broken)
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
        monkeypatch.setattr(frames, "open", read)
        page.get_by_test_id("frame-retry").click()
        expect(shown).to_have_attribute("src", re.compile(f"/frames/{second}/"))
        expect(problem).to_be_hidden()
        monkeypatch.setattr(frames, "open", broken)


@pytest.mark.parametrize("choice", ["theirs", "mine"])
def test_a_stale_edit_shows_both_versions_and_loses_neither(desk: Desk, wait_for, choice: str) -> None:
    frame, uid, before = desk.frame, desk.uid, desk.label.box
    # a change that the page has not heard of
    change = Change(desk.project.frames.get(frame).revision, "Bob")
    desk.project.labels.accept(frame, uid, change)
    desk.press("f")
    desk.page.get_by_test_id("stale-dialog").wait_for()
    assert desk.label.state is ReviewState.ACCEPTED
    desk.page.get_by_test_id(f"dialog-{choice}").click()
    desk.page.get_by_test_id("stale-dialog").wait_for(state="detached")
    wanted = ReviewState.ACCEPTED if choice == "theirs" else ReviewState.EDITED
    wait_for(lambda: desk.label.state is wanted, 5)
    size = before.size_m if choice == "theirs" else before.size_m[[1, 0, 2]]
    np.testing.assert_allclose(desk.label.box.size_m, size, atol=1e-9)
    desk.settled()
    assert desk.page.get_by_test_id("label-state").inner_text() == wanted.value


def test_a_box_that_could_not_be_saved_stays_until_it_is_saved_or_discarded(desk: Desk, wait_for) -> None:
    page, first, here = desk.page, desk.uid, desk.page.url
    size = desk.label.box.size_m
    page.route("**/changes", lambda route: route.abort())
    desk.press("f", "Tab")
    row = page.locator(f'[data-testid="frame-box"][data-uid="{first}"]')
    expect(row).to_contain_text("not saved")
    assert desk.uid != first
    row.click()
    expect(page.get_by_test_id("not-saved")).to_contain_text("Not saved")
    assert float(page.get_by_test_id("field-size-length").input_value()) == pytest.approx(size[1], abs=6e-4)
    assert page.evaluate("!dispatchEvent(new Event('beforeunload', { cancelable: true }))")

    # nobody leaves it behind without a word
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
    wait_for(lambda: desk.project.labels.get(first).label.state is ReviewState.EDITED, 5)
    np.testing.assert_allclose(desk.label.box.size_m, size[[1, 0, 2]], atol=1e-9)
    expect(page.get_by_test_id("not-saved")).to_be_hidden()
    assert page.evaluate("dispatchEvent(new Event('beforeunload', { cancelable: true }))")

    page.route("**/changes", lambda route: route.abort())
    desk.press("f")
    page.get_by_test_id("draft-discard").click()
    expect(page.get_by_test_id("label-state")).to_have_text("edited")
    desk.press("n")
    expect(page).not_to_have_url(here)


# The rule by itself: states as the server sends them, and what is shown after each.
OVERTAKING = """async () => {
  const load = (name) => import(`/assets/js/${name}.js`);
  const { createFrameState } = await load("frame_state");
  const { createState } = await load("state");
  const picture = (project, id) => ({ url: `/${project}/${id}` });
  const frame = (revision, id = 1, project = "room") => ({ frame: { id, revision }, image: picture(project, id) });
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
