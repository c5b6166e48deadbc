"""Review in a real browser: boxes that are changed in their views and by numbers, fitted, drawn on the image or copied;
and the 3D view: drawing, keys that are forwarded to the page, and clicks. tests/page/geometry.test.js has the geometry
of the views.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from browser_page import FRAMES, Desk, drag, drag_box, label_truth, middle, seen_by_viewer, until
from drawing import Scene
from PIL import Image
from scipy.spatial.transform import Rotation

from annotator.project import Project, WriteContext
from annotator.project.classes.edit import AddClass
from annotator.types import BoxKind, OrientedBox, ReviewState
from annotator.workflows.workbench.loaded_detectors import Readiness, ReadyDetector

if TYPE_CHECKING:
    from conftest import Shop
    from live_server import Live
    from playwright.sync_api import Page

    from annotator.workflows.detectors import Detectors


expect = pytest.importorskip("playwright.sync_api").expect


def test_numbers_and_the_handle_of_the_views_change_a_box(desk: Desk, wait_for) -> None:
    page, before = desk.page, desk.label.box
    revision = desk.project.frames.get(desk.frame).revision
    field = page.get_by_test_id("field-center-x")
    was = field.input_value()
    field.fill("9.5")
    field.press("Escape")
    expect(field).to_have_value(was)
    assert desk.label.state is ReviewState.PROPOSED
    field = page.get_by_test_id("field-size-length")
    field.fill("1.25")
    expect(page.get_by_test_id("label-state")).to_have_text("not saved")
    field.press("Enter")
    wait_for(lambda: desk.label.state is ReviewState.EDITED)
    assert desk.label.box.size_m[0] == pytest.approx(1.25)
    assert desk.project.frames.get(desk.frame).revision == revision + 1
    desk.settled()

    # the handle turns it about its centre
    before = desk.label.box
    handle = middle(page.get_by_test_id("ortho-top").get_by_test_id("rotate-handle"))
    center = middle(desk.box("top"))
    angle = np.radians(30)
    arm = np.subtract(handle, center)
    turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ arm
    desk.drag(handle, (center[0] + turned[0], center[1] + turned[1]))
    wait_for(lambda: np.abs(desk.label.box.rotation - before.rotation).max() > 0.1)
    after = desk.label.box
    turn = Rotation.from_matrix(before.rotation.T @ after.rotation).as_rotvec()
    assert np.linalg.norm(turn) == pytest.approx(angle, abs=np.radians(1.5))
    assert abs(turn[2]) == pytest.approx(np.linalg.norm(turn), rel=1e-3)  # seen from the top: about the box's own z
    np.testing.assert_allclose(after.center_m, before.center_m, atol=1e-6)
    np.testing.assert_allclose(after.size_m, before.size_m, atol=1e-9)
    desk.settled()  # the new views are along the new axes, where the box is a rectangle


def test_the_gizmo_of_the_3d_view_moves_the_box(desk_3d: Desk, wait_for) -> None:
    desk, page = desk_3d, desk_3d.page
    with page.expect_response(lambda response: '"gizmo":"translate"' in (response.request.post_data or "")) as answer:
        desk.press("t")
    expect(page.get_by_test_id("gizmo-translate")).to_have_attribute("aria-pressed", "true")
    bench = desk.live.server.app.state.viewports.get(answer.value.url.split("/")[-2], "Grace")
    box, uid = desk.label.box, desk.uid
    wait_for(lambda: bench._scene.content.selected == uid)
    node = bench._server.scene.get_handle_by_name("/selected")
    rect = page.get_by_test_id("viewport").bounding_box()
    assert rect is not None
    page.wait_for_timeout(1000)  # until the gizmo is drawn

    def on_axis(axis: int, share: float) -> tuple[float, float]:
        return seen_by_viewer(bench, rect, box.center_m + share * node.scale * box.rotation[:, axis])

    # drags the arrow that is longest on the screen, from its middle outwards
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
    wait_for(lambda: desk.project.labels.get(uid).label.state is ReviewState.EDITED)
    after = desk.project.labels.get(uid).label.box
    moved = after.center_m - box.center_m
    assert np.linalg.norm(moved) > 0.05
    np.testing.assert_allclose(moved / np.linalg.norm(moved), box.rotation[:, axis], atol=2e-3)
    np.testing.assert_allclose(after.size_m, box.size_m, atol=1e-9)
    np.testing.assert_allclose(after.rotation, box.rotation, atol=1e-6)


def test_the_bar_of_the_3d_view_filters_colours_and_moves_the_viewer_and_a_handle_moves_a_face(
    desk_3d: Desk, wait_for
) -> None:
    desk, page = desk_3d, desk_3d.page
    (bench,) = (one for one in desk.live.server.app.state.viewports._open.values() if one.project == desk.name)
    note = page.get_by_test_id("viewport-points")
    expect(note).not_to_be_empty()
    all_points = note.get_attribute("title")
    desk.press("h")
    expect(page.get_by_test_id("hide-ground")).to_have_attribute("aria-pressed", "true")
    expect(note).not_to_have_attribute("title", all_points)
    desk.press("h")
    expect(note).to_have_attribute("title", all_points)
    page.get_by_test_id("most-height").fill("0")
    expect(note).not_to_have_attribute("title", all_points)
    page.get_by_test_id("most-height").fill("11")
    page.get_by_test_id("boxes-color").select_option("class")
    wait_for(lambda: all(shown.color is not None for shown in bench._scene.content.boxes))
    desk.press("u")
    expect(page.get_by_test_id("points-color")).to_have_value("unlabelled")
    wait_for(lambda: bench._scene.content.color == "unlabelled")
    # again: a box of what stands there in no box, as long as there is any
    selected = desk.uid
    with page.expect_response(lambda response: response.url.endswith("/unlabelled")) as answer:
        desk.press("u")
    assert set(answer.value.json()) >= {"box", "label", "distance"}
    if answer.value.json()["box"]:
        expect(page.get_by_test_id("label-state")).to_have_text("new")
        desk.press("Delete")
        page.locator(f'[data-testid="frame-box"][data-uid="{selected}"]').click()
    page.get_by_test_id("points-color").select_option("rgb")
    wait_for(lambda: bench._scene.content.color == "rgb")

    box, uid = desk.label.box, desk.uid
    (client,) = bench._server.get_clients().values()
    # what was offered as unlabelled has moved the viewer, or will
    start = np.array(bench._server.initial_camera.position)
    page.get_by_test_id("look-top").click()
    up = bench._scene._ground.axes[2]
    wait_for(
        lambda: (
            (client.camera.position - box.center_m) @ up > 0.99 * np.linalg.norm(client.camera.position - box.center_m)
        )
    )
    page.get_by_test_id("look-start").click()
    wait_for(lambda: np.abs(client.camera.position - start).max() < 1e-3)
    desk.press("o")
    wait_for(lambda: np.abs(client.camera.look_at - box.center_m).max() < 1e-3)

    # pulls the handle that faces the viewer, of the axis that is longest on the screen
    rect = page.get_by_test_id("viewport").bounding_box()
    assert rect is not None

    def on_screen(axis: int, share: float) -> tuple[float, float]:
        return seen_by_viewer(bench, rect, box.center_m + share * box.size_m[axis] * box.rotation[:, axis])

    def handle() -> tuple[int, float]:
        lengths = [np.linalg.norm(np.subtract(on_screen(axis, 0.5), on_screen(axis, 0.0))) for axis in range(3)]
        axis = int(np.argmax(lengths))
        return axis, float(np.sign((client.camera.position - box.center_m) @ box.rotation[:, axis]))

    def is_drawn() -> bool:
        """The handle is the only thing there that is nearly white. A busy browser reports its earlier cameras late."""
        axis, sign = handle()
        x, y = on_screen(axis, 0.5 * sign)
        picture = page.screenshot(clip={"x": x - 3, "y": y - 3, "width": 6, "height": 6})
        return bool(np.asarray(Image.open(io.BytesIO(picture))).min(axis=2).max() > 215)

    until(page, is_drawn)
    axis, sign = handle()
    grip, end = on_screen(axis, 0.5 * sign), on_screen(axis, 0.6 * sign)
    page.mouse.move(*grip)
    page.mouse.down()
    page.mouse.move(*end, steps=8)
    expect(page.get_by_test_id("label-state")).to_have_text("not saved")
    page.mouse.up()
    wait_for(lambda: desk.project.labels.get(uid).label.state is ReviewState.EDITED)
    after = desk.project.labels.get(uid).label.box
    grown = after.size_m - box.size_m
    assert grown[axis] > 0.02
    np.testing.assert_allclose(np.delete(grown, axis), 0, atol=1e-9)
    np.testing.assert_allclose(
        after.center_m - box.center_m, 0.5 * sign * grown[axis] * box.rotation[:, axis], atol=1e-6
    )


def draw_on_image(desk: Desk, box: dict[str, Any]) -> None:
    drag_box(desk.page, "image-editor", box, 320, 240)


def test_boxes_are_drawn_by_a_drag_fitted_again_and_copied_from_the_previous_frame(desk: Desk, wait_for) -> None:
    asked, note = desk.page.get_by_test_id("act-draw"), desk.page.get_by_test_id("image-note")
    desk.press("b")
    expect(asked).to_have_attribute("aria-pressed", "true")
    expect(note).to_have_text("Drag a box around a person. Press Esc to cancel.")
    desk.press("Escape")
    expect(asked).to_have_attribute("aria-pressed", "false")
    expect(note).to_have_text("")
    # a digit during the drag chooses the class, and a short drag draws nothing
    desk.project.change_classes(AddClass(name="chair"), "Ada")
    page = desk.page
    page.reload()
    desk.settled()
    x, y = middle(page.get_by_test_id("image-editor").locator("img.picture"))
    fits: list[dict[str, Any]] = []

    def keep(route: Any) -> None:
        fits.append(route.request.post_data_json["image_box"])
        route.abort()

    page.route("**/fit", keep)
    boxes = page.get_by_test_id("image-editor").get_by_test_id("editor-box")
    drag(page, (x, y), (x + 5, y + 5))
    expect(boxes).to_have_count(0)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 20, y + 30)
    expect(boxes.locator("text")).to_have_text("person")
    desk.press("2")
    page.mouse.move(x + 30, y + 40)
    expect(boxes.locator("text")).to_have_text("chair")
    with page.expect_event("requestfailed"):
        page.mouse.up()
    expect(boxes).to_have_count(0)
    assert [fit["label"] for fit in fits] == ["chair"]
    assert desk.label.label == "person"  # the digit was not for the selected box
    page.unroute("**/fit")
    # an object with too few points is not sent to views that do not exist
    sparse = {
        "box": None,
        "outline": [],
        "points": 0,
        "score": None,
        "quality": None,
        "measured_by": "the base detector",
        "suggestion": None,
        "note": "fewer than 5 points lie in this box",
        "too_few_points": True,
    }
    held: list[Any] = []
    page.route("**/fit", lambda route: held.append(route))
    with page.expect_request("**/fit"):
        drag(page, (x, y), (x + 30, y + 40))
    # meanwhile, Space does not take the box that was selected before
    before = desk.uid
    page.keyboard.press("Space")
    expect(note).to_have_text("Fitting a 3D box …")
    assert desk.uid == before
    assert desk.label.state is ReviewState.PROPOSED
    held[0].fulfill(json=sparse)
    toast = desk.page.get_by_test_id("toast-warn").last
    expect(toast).to_contain_text("Fewer than 5 points lie in this box. Label the object")
    expect(toast).to_contain_text("copy its box here")
    expect(desk.page.get_by_test_id("image-note")).to_have_text("")
    assert f"/annotate/{desk.frame}" in desk.page.url
    desk.page.unroute("**/fit")

    # fitting again starts from the box
    frame, label = desk.frame, desk.label
    off = OrientedBox.from_parts(label.box.center_m + np.array([0.15, 0, 0]), label.box.rotation, label.box.size_m)
    context = WriteContext(desk.project.frames.get(frame).revision, "Bob")
    desk.project.labels.edit(frame, label.uid, context, label=label.label, box=off)
    desk.page.reload()
    desk.page.locator(f'[data-testid="frame-box"][data-uid="{label.uid}"]').click()
    desk.settled()
    with desk.page.expect_response(lambda response: response.url.endswith("/refit")) as answer:
        desk.press("g")
    assert answer.value.ok
    fitted = np.array(answer.value.json()["box"]["center"])
    wait_for(lambda: np.abs(desk.label.box.center_m - fitted).max() < 1e-6)
    desk.settled()

    frames = [stored.id for stored in desk.project.frames.of()]
    for label in desk.project.labels.of_frame(frames[FRAMES - 1]):
        if label.state is ReviewState.EDITED:
            continue
        context = WriteContext(desk.project.frames.get(frames[FRAMES - 1]).revision, "Bob")
        desk.project.labels.accept(frames[FRAMES - 1], label.uid, context)
    before = desk.project.labels.of_frame(frames[FRAMES - 1])
    desk.page.goto(f"/#/{desk.name}/annotate/{frames[FRAMES]}")
    desk.page.get_by_test_id("frame-summary").get_by_text("0 boxes").wait_for()
    desk.press("c")
    wait_for(lambda: len(desk.project.labels.of_frame(frames[FRAMES])) == len(before))
    copies = desk.project.labels.of_frame(frames[FRAMES])
    assert {label.state for label in copies} == {ReviewState.PROPOSED}
    assert all(np.array_equal(a.box.size_m, b.box.size_m) for a, b in zip(copies, before, strict=True))
    # the first one is selected: Space accepts it
    desk.page.locator(f'[data-testid="frame-box"][aria-current="true"][data-uid="{copies[0].uid}"]').wait_for()
    desk.settled()
    desk.press("Control+z")
    wait_for(lambda: not desk.project.labels.of_frame(frames[FRAMES]))
    expect(note).to_have_text("Drag a box around an object to add it.")
    # one that was copied to where nothing is says so
    box = before[0].box
    away = OrientedBox.from_parts(box.center_m + np.array([0.0, -30.0, 0.0]), box.rotation, box.size_m)
    context = WriteContext(desk.project.frames.get(frames[FRAMES - 1]).revision, "Bob")
    desk.project.labels.edit(frames[FRAMES - 1], before[0].uid, context, label=before[0].label, box=away)
    desk.press("c")
    expect(desk.page.get_by_text("1 copy holds no points here: move or delete it.")).to_be_visible()


def test_a_new_box_is_drawn_on_the_image(
    desk: Desk, generated: Path, knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch, wait_for
) -> None:
    page, known = desk.page, {stored.label.uid for stored in desk.project.labels.select()}
    ready = Readiness("ready", ReadyDetector(knowing("people", kind=BoxKind.BOX).view, BoxKind.BOX, Lock()))
    detectors = desk.live.context.caches.detectors
    monkeypatch.setattr(detectors, "readiness", lambda project, role, wait_s=None: ready)
    index = desk.project.frames.get(desk.frame).index
    assert index is not None
    scene = Scene.of(generated / "people", index, ("person",))
    with page.expect_request("**/models/load"):  # when the first drag begins
        draw_on_image(desk, scene.image_box(0))
    expect(page.get_by_test_id("label-state")).to_have_text("new")
    desk.settled()
    desk.press("t")  # gizmo and views work as for other boxes
    field = page.get_by_test_id("field-size-length")
    was = field.input_value()
    for key in ("Enter", "Escape"):  # only the number comes back
        field.fill("")
        field.press(key)
        expect(field).to_have_value(was)
    field.fill("0.9")
    field.press("Enter")
    assert {stored.label.uid for stored in desk.project.labels.select()} == known
    desk.press("n")  # the page asks before it leaves a box that is not accepted
    expect(page.get_by_test_id("unsaved-dialog")).to_contain_text("1 new box, not accepted yet")
    page.get_by_test_id("dialog-stay").click()
    page.locator("dialog").wait_for(state="detached")
    page.get_by_test_id("ortho-top").get_by_test_id("editor2d").focus()
    desk.press("ArrowRight", "Space")  # an arrow key leaves unsaved changes for a moment
    wait_for(lambda: len(desk.project.labels.select()) == len(known) + 1)
    (made,) = (stored for stored in desk.project.labels.select() if stored.label.uid not in known)
    assert made.label.state is ReviewState.ACCEPTED and made.image_box is not None
    assert made.label.box.size_m[0] == pytest.approx(0.9)
    assert made.label.suggestion is not None and made.label.suggestion.corrected
    assert np.linalg.norm(made.label.box.center_m - scene.objects[0].box.center_m) < 0.1
    statistics = desk.live.client.get(f"{desk.api}/statistics").json()
    assert (
        statistics["effort"]["by_origin"]["from nothing"]["actions_a_box"] == 4
    )  # the drag, the number, the arrow, Space
    # it stays selected, so that it can be followed
    page.locator(f'[data-testid="frame-box"][aria-current="true"][data-uid="{made.label.uid}"]').wait_for()
    expect(page.get_by_test_id("act-follow")).to_be_enabled()
    # one key accepts a new box and follows it
    desk.settled()
    draw_on_image(desk, scene.image_box(1))
    expect(page.get_by_test_id("label-state")).to_have_text("new")
    desk.press("v")
    expect(page.get_by_test_id("follow-title")).to_contain_text("Followed forward")
    assert desk.project.labels.count([ReviewState.ACCEPTED]) == 2

    # without a detector, the box is continued on the pseudo-views
    monkeypatch.setattr(detectors, "readiness", lambda project, role, wait_s=None: Readiness("none"))
    desk.settled()
    frame = desk.frame
    page.goto(f"/#/{desk.name}/annotate/{frame}")
    desk.settled()
    draw_on_image(desk, scene.image_box(0))
    expect(page).to_have_url(re.compile(f"/annotate/{frame}$"))
    expect(page.get_by_test_id("toast-warn").last).to_contain_text("There is no pseudo-view detector yet")
    expect(page.get_by_test_id("object")).to_have_attribute("data-boxes", "1")
    page.wait_for_selector(".annotate:not([data-saving])")
    state = desk.live.client.get(f"{desk.api}/frames/{frame}").json()
    assert [len(drawn["views"]) for drawn in state["objects"]] == [0]
    (kept,) = state["image_boxes"]["boxes"]
    assert all(abs(kept[edge] - scene.image_box(0)[edge]) < 0.6 for edge in ("x_min", "y_min", "x_max", "y_max"))


def test_a_click_in_the_top_view_places_a_box_and_a_drag_moves_and_turns_it(desk: Desk, wait_for) -> None:
    page, first = desk.page, desk.uid
    desk.press("Space")  # a reviewed box tells how large a person is
    wait_for(lambda: desk.uid != first)
    desk.settled()
    frame = desk.frame
    known = {label.uid for label in desk.project.labels.of_frame(frame)}
    desk.press("m")
    view = page.get_by_test_id("map")
    view.locator("img.picture[src]").wait_for()
    around = view.bounding_box()
    assert around is not None
    page.mouse.click(around["x"] + 0.5 * around["width"], around["y"] + 0.1 * around["height"])
    expect(page.get_by_test_id("label-state")).to_have_text("new")
    desk.settled()
    before = float(page.get_by_label("x in m").input_value())
    box, handle = view.locator(".box.selected polygon"), page.get_by_test_id("map-handle")
    (x, y), (turn_x, turn_y) = middle(box), middle(handle)
    desk.drag((x, y), (x + 60, y))
    wait_for(lambda: float(page.get_by_label("x in m").input_value()) > before + 0.3)
    yaw = page.get_by_label("yaw in °").input_value()
    desk.drag((turn_x + 60, turn_y), (x + 60 + abs(turn_y - y) + 20, y))
    wait_for(lambda: page.get_by_label("yaw in °").input_value() != yaw)
    desk.press("Space")
    new = lambda: [label for label in desk.project.labels.of_frame(frame) if label.uid not in known]  # noqa: E731
    wait_for(lambda: len(new()) == 1)
    assert new()[0].state is ReviewState.ACCEPTED and new()[0].box.center_m[0] > before + 0.3
    # a click on a box selects it
    desk.settled()
    desk.press("Escape")
    page.mouse.click(x + 60, y)
    expect(page.locator('[data-testid="frame-box"][aria-current="true"]')).to_have_attribute("data-uid", new()[0].uid)


STARTS_S = 60.0
# Of the view, the bar above it, and the buttons at its lower edge.
LEFT, TOP, WIDTH, HEIGHT = 200, 100, 700, 520
BAR, BUTTONS = 28, 34

# Loads the page's modules without a mode; `told` and `pressed` record the events of `view` and the keys.
PAGE = """async ([project, left, top, width, height]) => {
  const load = (name) => import(`/assets/js/${name}.js`);
  const [viewport, keys, api, events, effort, state] = await Promise.all(
    ["viewport", "keys", "api", "events", "effort", "frame_state"].map(load));
  const app = { effort: effort.createEffort(), events: events.createEvents(), keys: keys.createKeys(),
    state: state.createState({ route: { project } }) };
  app.api = api.createApi(app.effort, () => {});
  app.events.follow(project);
  app.keys.setMode("annotate");
  app.keys.listen(window);
  window.pressed = [];
  app.keys.register({ accept: () => pressed.push("Space"), "next-box": () => pressed.push("Tab"),
    nudge: (key) => pressed.push(key), undo: () => pressed.push("Ctrl+Z") });
  const host = document.createElement("div");
  host.style.cssText = `position: fixed; left: ${left}px; top: ${top}px; width: ${width}px; height: ${height}px`;
  window.view = viewport.createViewport(app);
  document.body.append(host);
  window.host = host;
  window.told = { box: [], select: [] };
  window.user = { onBox: (moved) => told.box.push(moved), onSelect: (uid) => told.select.push(uid) };
  view.attach(host, user);
}"""


def begin(page: Page, room: Project) -> None:
    """Opens the page's modules without a mode."""
    page.goto("/")
    page.evaluate(PAGE, [room.path.name, LEFT, TOP - BAR, WIDTH, HEIGHT + BAR])


def show(page: Page, **scene: Any) -> None:
    page.evaluate("(scene) => view.show(scene)", scene)


def picture(page: Page) -> np.ndarray:
    """The screenshot of the view without its buttons, as int RGB."""
    clip = {"x": LEFT, "y": TOP, "width": WIDTH, "height": HEIGHT - BUTTONS}
    return np.asarray(Image.open(io.BytesIO(page.screenshot(clip=clip))).convert("RGB")).astype(int)


def drawn(page: Page) -> float:
    """The fraction of the view's pixels that are not background."""
    seen = picture(page)
    return float((np.abs(seen - seen[2, 2]).max(axis=2) > 24).mean())


def bench(live: Live, page: Page) -> Any:
    return live.server.app.state.viewports.get(page.evaluate("view.id"), "Grace")


def camera(live: Live, page: Page) -> np.ndarray:
    """The position and orientation of viser's camera."""
    (client,) = bench(live, page)._server.get_clients().values()
    return np.concatenate([client.camera.position, client.camera.wxyz])


def on_screen(live: Live, page: Page, point: np.ndarray) -> tuple[float, float]:
    """The position on the page of a point in the camera frame."""
    return seen_by_viewer(bench(live, page), {"x": LEFT, "y": TOP, "width": WIDTH, "height": HEIGHT}, point)


def test_the_view_draws_a_cloud_forwards_keys_selects_and_outlives_its_server(
    shared_page_3d: Page, live: Live, shop: Shop, room: Project
) -> None:
    view, frames = shared_page_3d, shared_page_3d.get_by_test_id("viewport-frame")
    label_truth(room, shop.recording, 1)
    labels = list(room.labels.of_frame(room.frames.of()[0].id))
    begin(view, room)
    # a held view starts when it is let go
    view.evaluate("() => { view.show({ frame: 1, look: 'start' }); window.release = view.hold(); }")
    until(view, "view.id !== null", STARTS_S)
    assert frames.count() == 0
    view.evaluate("release()")
    until(view, "view.state === 'ready'", STARTS_S)
    until(view, lambda: drawn(view) > 0.3)
    # one that is shown stays
    view.evaluate("() => { window.release = view.hold(); }")
    assert frames.is_visible()
    view.evaluate("release()")

    # the cloud has its colours
    mean = picture(view).reshape(-1, 3)
    mean = mean[np.abs(mean - mean[0]).max(axis=1) > 24].mean(axis=0)
    cloud = live.context.caches.frames.read(room, 1).cloud
    np.testing.assert_allclose(mean, cloud.rgb.mean(axis=0), atol=30)
    frame = view.frame_locator("[data-testid=viewport-frame]")
    assert frame.locator(".mantine-Paper-root:visible, .mantine-Notifications-root:visible").count() == 0
    assert frame.locator("canvas:visible").count() >= 1

    # a click selects a box
    nearest = min(labels, key=lambda label: label.box.center_m[2])
    view.mouse.click(*on_screen(live, view, nearest.box.center_m))
    until(view, "told.select.length > 0")
    assert view.evaluate("told.select[0]") == nearest.uid

    # keys are forwarded to the page, and do not move the camera
    view.mouse.click(LEFT + 10, TOP + 10)
    assert view.evaluate("document.activeElement.dataset.testid") == "viewport-frame"
    view.wait_for_timeout(500)
    before, seen = camera(live, view), picture(view)
    for key in ("w", "a", "s", "d", "q", "e", "ArrowUp", "ArrowDown", "ArrowLeft", "ArrowRight"):
        view.keyboard.down(key)
        view.wait_for_timeout(150)
        view.keyboard.up(key)
    for key in ("Space", "Tab", "Control+z"):
        view.keyboard.press(key)
    arrows = ["ArrowUp", "ArrowDown", "ArrowLeft", "ArrowRight"]
    assert view.evaluate("pressed") == [*arrows, "Space", "Tab", "Ctrl+Z"]
    view.wait_for_timeout(500)
    np.testing.assert_array_equal(camera(live, view), before)
    assert np.abs(picture(view) - seen).mean() < 0.1

    # the mouse rotates the camera
    view.mouse.move(LEFT + 100, TOP + 450)
    view.mouse.down()
    view.mouse.move(LEFT + 200, TOP + 430, steps=5)
    view.mouse.up()
    until(view, lambda: np.abs(camera(live, view) - before).max() > 0.01)

    show(view, frame=None)
    until(view, lambda: drawn(view) < 0.01)
    show(view, frame=1)
    until(view, lambda: drawn(view) > 0.1)

    # a frame that does not exist is told, and the view stays
    known = view.evaluate("view.id")
    show(view, frame=99)
    until(view, "view.state === 'lost'")
    show(view, frame=1)
    until(view, "view.state === 'ready'")

    # the view survives moving and a server's restart, and closes with the page
    view.evaluate("view.detach()")
    until(view, lambda: not view.get_by_test_id("viewport-frame").is_visible())
    view.evaluate("host.style.width = '400px'; view.attach(host, user)")
    until(view, "document.querySelector('[data-testid=viewport-frame]')?.getBoundingClientRect().width === 400")
    assert view.evaluate("[view.id, view.state]") == [known, "ready"]
    until(view, lambda: drawn(view) > 0.1)

    # the server has closed the view, or was restarted
    assert view.request.delete(f"{live.url}/api/workbench/{known}", headers={"Origin": live.url}).ok
    show(view, frame=2)
    until(view, f"view.id !== null && view.id !== '{known}' && view.state === 'ready'")
    assert bench(live, view)._scene.content.frame.index == 1

    def count() -> int:
        """Of this page: that of another test, closed while it was busy, is open for another minute."""
        return sum(each.project == room.path.name for each in live.server.app.state.viewports._open.values())

    assert count() == 1
    view.goto("about:blank")
    until(view, lambda: count() == 0)
