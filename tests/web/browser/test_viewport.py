"""The 3D view in a real browser: drawing, keys that are forwarded to the page, and clicks."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np
from browser_page import label_truth, seen_by_viewer, until
from PIL import Image

from annotator.project import Project

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
    ["viewport", "keys", "api", "events", "effort", "frame_state"].map(load));
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


def begin(page: Page, room: Project) -> None:
    """Opens the page's modules without a mode."""
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
    """Its gizmo is in test_review_box.py."""
    view, frames = shared_page_3d, shared_page_3d.get_by_test_id("viewport-frame")
    label_truth(room, shop.recording, 1)
    labels = list(room.labels.of_frame(room.frames.of()[0].id))
    begin(view, room)
    # a held view starts when it is let go
    view.evaluate("() => { view.show({ frame: 1, reset_view: true }); window.release = view.hold(); }")
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
    cloud = live.context.frame(room, 1).cloud
    np.testing.assert_allclose(mean, cloud.rgb.mean(axis=0), atol=30)
    frame = view.frame_locator("[data-testid=viewport-frame]")
    assert frame.locator(".mantine-Paper-root:visible, .mantine-Notifications-root:visible").count() == 0
    assert frame.locator("canvas:visible").count() >= 1

    # a click selects a box
    nearest = min(labels, key=lambda label: label.box.center_m[2])
    view.mouse.click(*on_screen(live, view, nearest.box.center_m))
    until(view, "told.select.length > 0")
    assert view.evaluate("told.select[0].uid") == nearest.uid

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

    # the view survives moving and a server's restart, and closes with the page
    known = view.evaluate("view.id")
    view.evaluate("view.detach()")
    until(view, lambda: not view.get_by_test_id("viewport-frame").is_visible())
    view.evaluate("host.style.width = '400px'; host.append(view.element)")
    until(view, "document.querySelector('[data-testid=viewport-frame]')?.getBoundingClientRect().width === 400")
    assert view.evaluate("[view.id, view.state]") == [known, "ready"]
    until(view, lambda: drawn(view) > 0.1)

    # the server has closed the view, or was restarted
    assert view.request.delete(f"{live.url}/api/workbench/{known}", headers={"Origin": live.url}).ok
    show(view, frame=2)
    until(view, f"view.id !== null && view.id !== '{known}' && view.state === 'ready'")
    assert bench(live, view)._scene.content.frame.index == 1

    benches = live.server.app.state.viewports
    assert len(benches._open) == 1
    view.goto("about:blank")
    until(view, lambda: len(benches._open) == 0)
