"""The 3D view in a real browser: drawing, keys that are forwarded to the page, clicks and the gizmo."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from browser_page import label_truth, seen_by_viewer, sign_in, until
from PIL import Image

from annotator.project import Project
from annotator.types import Label

if TYPE_CHECKING:
    from conftest import Shop
    from live_server import Live
    from playwright.sync_api import Page

STARTS_S = 60.0
LEFT, TOP, WIDTH, HEIGHT = 200, 100, 700, 520

# Loads the page's modules without a mode; `told` and `pressed` record the events of `view` and the keys.
PAGE = """async ([project, left, top, width, height]) => {
  const load = (name) => import(`/assets/js/${name}.js`);
  const [viewport, keys, api, events, effort, state] = await Promise.all(
    ["viewport", "keys", "api", "events", "effort", "state"].map(load));
  const app = { effort: effort.createEffort(), events: events.createEvents(), keys: keys.createKeys(),
    state: state.createState({ route: { project } }) };
  app.api = api.createApi(app.effort, () => {});
  app.events.follow(project);
  app.keys.setMode("review");
  app.keys.listen(window);
  window.pressed = [];
  app.keys.register({ accept: () => pressed.push("Space"), "next-box": () => pressed.push("Tab"),
    nudge: (event, key) => pressed.push(key), undo: () => pressed.push("Ctrl+Z") });
  const host = document.createElement("div");
  host.style.cssText = `position: fixed; left: ${left}px; top: ${top}px; width: ${width}px; height: ${height}px`;
  window.view = viewport.createViewport(app);
  host.append(view.element);
  document.body.append(host);
  window.host = host;
  window.told = { box: [], select: [], shown: [], state: [] };
  for (const event of Object.keys(told)) view.on(event, (value) => told[event].push(value));
}"""


@pytest.fixture
def live(shop: Shop) -> Live:
    """The server shared by the tests of a file."""
    return shop.live


@pytest.fixture(scope="module")
def room(shop: Shop) -> Project:
    """A project with true boxes on its first frame."""
    project = shop.new_project()
    label_truth(project, shop.recording, 1)
    return project


@pytest.fixture
def labels(room: Project) -> list[Label]:
    """The boxes on the first frame."""
    return list(room.labels.of_frame(room.frames.of()[0].id))


@pytest.fixture
def view(shared_page_3d: Page, shop: Shop, room: Project) -> Iterator[Page]:
    """The shared page with the view of the first frame, connected and drawn."""
    page = shared_page_3d
    if not page.evaluate("'view' in window"):
        begin(page, shop.live, room)
    show(page, frame=1, reset_view=True)
    until(page, "view.state === 'ready'", STARTS_S)
    until(page, lambda: drawn(page) > 0.1)
    page.evaluate("() => { for (const list of [pressed, ...Object.values(told)]) list.length = 0; }")
    yield page


def begin(page: Page, live: Live, room: Project) -> None:
    """Opens the page's modules without a mode."""
    sign_in(page, live.url)
    page.goto("/")
    page.evaluate(PAGE, [room.path.name, LEFT, TOP, WIDTH, HEIGHT])


def show(page: Page, **scene: Any) -> None:
    page.evaluate("(scene) => view.show(scene)", scene)


def picture(page: Page) -> np.ndarray:
    """The screenshot of the view, as int RGB."""
    clip = {"x": LEFT, "y": TOP, "width": WIDTH, "height": HEIGHT}
    return np.asarray(Image.open(io.BytesIO(page.screenshot(clip=clip))).convert("RGB")).astype(int)


def drawn(page: Page) -> float:
    """The fraction of the view's pixels that are not background."""
    seen = picture(page)
    return float((np.abs(seen - seen[2, 2]).max(axis=2) > 24).mean())


def bench(live: Live, page: Page) -> Any:
    return live.server.app.state.viewports.get(page.evaluate("view.id"), "Ada")


def camera(live: Live, page: Page) -> np.ndarray:
    """The position and orientation of viser's camera."""
    (client,) = bench(live, page)._server.get_clients().values()
    return np.concatenate([client.camera.position, client.camera.wxyz])


def on_screen(live: Live, page: Page, point: np.ndarray) -> tuple[float, float]:
    """The position on the page of a point in the camera frame."""
    return seen_by_viewer(bench(live, page), {"x": LEFT, "y": TOP, "width": WIDTH, "height": HEIGHT}, point)


def test_the_cloud_is_drawn_in_its_colours_and_only_the_last_of_many_scenes(
    view: Page, live: Live, room: Project
) -> None:
    assert drawn(view) > 0.3
    mean = picture(view).reshape(-1, 3)
    mean = mean[np.abs(mean - mean[0]).max(axis=1) > 24].mean(axis=0)
    cloud = live.context.frame(room, 1).cloud
    np.testing.assert_allclose(mean, cloud.rgb.mean(axis=0), atol=30)
    frame = view.frame_locator("[data-testid=viewport-frame]")
    assert frame.locator(".mantine-Paper-root:visible, .mantine-Notifications-root:visible").count() == 0
    assert frame.locator("canvas:visible").count() >= 1

    before = view.evaluate("told.shown.length")
    view.evaluate("() => { for (let n = 0; n < 40; n += 1) view.show({ frame: 1 + (n % 5) }); }")
    until(view, lambda: bench(live, view)._scene.content.frame.index == 4)
    view.wait_for_timeout(500)
    assert bench(live, view)._scene.content.frame.index == 4
    assert view.evaluate("told.shown.length") - before <= 3

    show(view, frame=None)
    until(view, lambda: drawn(view) < 0.01)


def test_keys_in_the_view_are_forwarded_to_the_page_and_do_not_move_the_camera(view: Page, live: Live) -> None:
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


def test_a_click_selects_a_box_and_the_gizmo_moves_it(view: Page, live: Live, labels: list[Label]) -> None:
    nearest = min(labels, key=lambda label: label.box.center_m[2])
    view.mouse.click(*on_screen(live, view, nearest.box.center_m))
    until(view, "told.select.length > 0")
    assert view.evaluate("told.select[0].uid") == nearest.uid

    label = labels[0]
    show(view, frame=1, selected=label.uid, gizmo="translate")
    until(view, lambda: bench(live, view)._scene.content.selected == label.uid)
    view.wait_for_timeout(1000)
    node = bench(live, view)._server.scene.get_handle_by_name("/selected")
    axis = label.box.rotation[:, 0]
    # drags the arrow along the box's x axis, from its middle outwards
    start, end = (on_screen(live, view, label.box.center_m + share * node.scale * axis) for share in (0.6, 1.0))
    view.mouse.move(*start)
    view.wait_for_timeout(300)
    view.mouse.down()
    view.mouse.move(*end, steps=8)
    view.mouse.up()
    until(view, "told.box.some((event) => event.final)")
    events = view.evaluate("told.box")
    assert [event["final"] for event in events].count(True) == 1
    assert events[-1]["final"]
    assert {event["uid"] for event in events} == {label.uid}
    moved = np.array(events[-1]["box"]["center"]) - label.box.center_m
    assert np.linalg.norm(moved) > 0.05
    np.testing.assert_allclose(moved / np.linalg.norm(moved), axis, atol=1e-3)
    np.testing.assert_allclose(events[-1]["box"]["size"], label.box.size_m)
    np.testing.assert_allclose(events[-1]["box"]["rotation"], label.box.rotation, atol=1e-6)


def test_the_view_survives_moving_and_a_server_restart_and_closes_with_the_page(view: Page, live: Live) -> None:
    known = view.evaluate("view.id")
    view.evaluate("view.detach()")
    until(view, lambda: not view.get_by_test_id("viewport-frame").is_visible())
    view.evaluate("host.style.width = '400px'; host.append(view.element)")
    until(view, "document.querySelector('[data-testid=viewport-frame]')?.getBoundingClientRect().width === 400")
    assert view.evaluate("[view.id, view.state]") == [known, "ready"]
    until(view, lambda: drawn(view) > 0.1)

    # the server has closed the view, or was restarted
    live.client.delete(f"/api/workbench/{known}")
    show(view, frame=2)
    until(view, f"view.id !== null && view.id !== '{known}' && view.state === 'ready'")
    assert bench(live, view)._scene.content.frame.index == 1

    benches = live.server.app.state.viewports
    assert len(benches._open) == 1
    view.goto("about:blank")
    until(view, lambda: len(benches._open) == 0)


def test_a_held_view_starts_when_it_is_let_go(shared_page_3d: Page, live: Live, room: Project) -> None:
    page, frames = shared_page_3d, shared_page_3d.get_by_test_id("viewport-frame")
    begin(page, live, room)
    page.evaluate("() => { view.show({ frame: 1, reset_view: true }); window.release = view.hold(); }")
    until(page, "view.id !== null", STARTS_S)
    assert frames.count() == 0
    page.evaluate("release()")
    until(page, "view.state === 'ready'", STARTS_S)
    until(page, lambda: drawn(page) > 0.1)
    # one that is shown stays
    page.evaluate("() => { window.release = view.hold(); }")
    assert frames.is_visible()
    page.evaluate("release()")


def test_without_webgl_the_page_shows_a_note(shared_page: Page, live: Live, room: Project) -> None:
    known = list(live.server.app.state.viewports._open)
    begin(shared_page, live, room)
    show(shared_page, frame=1)
    assert shared_page.evaluate("view.state") == "unsupported"
    assert "no WebGL" in shared_page.get_by_test_id("viewport-note").inner_text()
    assert list(live.server.app.state.viewports._open) == known
