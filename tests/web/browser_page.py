"""What tests in a real browser have in common; see browser/conftest.py for the fixtures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from annotator.project import Change, NewLabel, Project
from annotator.recordings import open_recording
from annotator.workflows.truth import load_truth

if TYPE_CHECKING:
    from drawing import Scene
    from playwright.sync_api import Page, Response

    from annotator.web.viewport.workbench import Workbench

POLL_MS = 50


def until(page: Page, condition: str | Callable[[], object], seconds: float = 20.0) -> None:
    """Waits for a JavaScript expression, or a function here, to become true.

    `Page.wait_for_function` would evaluate a string within the page, which the page's own policy forbids.
    """
    for _ in range(int(seconds * 1000 / POLL_MS)):
        if condition() if callable(condition) else page.evaluate(condition):
            return
        page.wait_for_timeout(POLL_MS)
    raise AssertionError(f"not within {seconds} s: {condition}")


def refuse(page: Page, path: str) -> None:
    """Lets no request to a path that ends so reach the server, from now on: that is tried before the test goes on.

    Under load a request that is sent right after `route` has got through.
    """
    page.route(f"**/{path}", lambda route: route.abort())
    until(page, f"fetch('/refused/{path}').then(() => false, () => true)")


def sign_in(page: Page, url: str, operator: str = "Ada") -> None:
    """Signs in without the dialog, before the page is opened."""
    answer = page.request.post(f"{url}/api/session", data={"operator": operator}, headers={"Origin": url})
    assert answer.ok


def drag(page: Page, *points: tuple[float, float]) -> None:
    """Drags with the mouse from the first point through all others to the last."""
    page.mouse.move(*points[0])
    page.mouse.down()
    for point in points[1:]:
        page.mouse.move(*point)
    page.mouse.up()


def drag_box(page: Page, editor: str, box: dict[str, Any], width: int, height: int) -> None:
    """Drags a box out on the picture of an editor: pixels of the picture, the centre of the first is (0, 0)."""
    picture = page.get_by_test_id(editor).locator("img.picture")
    rect = picture.evaluate("(img) => img.getBoundingClientRect().toJSON()")
    scale = np.array([rect["width"] / width, rect["height"] / height])
    corner = np.array([rect["left"], rect["top"]])
    start = corner + (np.array([box["x_min"], box["y_min"]]) + 0.5) * scale
    end = corner + (np.array([box["x_max"], box["y_max"]]) + 0.5) * scale
    drag(page, tuple(start), tuple((start + end) / 2), tuple(end))


def brings_views(response: Response) -> bool:
    """The answer with the next views in Label, and not the one with what a detector suggests on them."""
    return response.url.endswith("/label/steps") and response.request.post_data_json["suggest"] is False


def draw_on_views(page: Page, scene: Scene, number: int, views: Sequence[dict[str, Any]]) -> None:
    """Drags the boxes of a true object on the two views that are shown."""
    for name, view in zip(("front", "side"), views, strict=True):
        shown = page.get_by_test_id(f"view-{name}").locator(f'img.picture[src="{view["url"]}"]')
        shown.wait_for(state="attached")
        drag_box(page, f"view-{name}", scene.view_box(number, view), view["width"], view["height"])


def label_truth(project: Project, recording: Path, frames: int) -> int:
    """Accepted boxes of all objects in the first frames; how many there are."""
    opened = open_recording(recording)
    made = 0
    for index, stored in enumerate(project.frames.of()[:frames]):
        truths = load_truth(opened, index, opened.frame(index))
        labels = [NewLabel(truth.label, truth.box, track_id=truth.track_id) for truth in truths]
        made += len(project.labels.create(stored.id, labels, Change(stored.revision, "Ada")).uids)
    return made


def seen_by_viewer(bench: Workbench, rect: dict[str, float], point: np.ndarray) -> tuple[float, float]:
    """Where a point of the camera frame is on the page, through the camera of the 3D view, which is at `rect`."""
    import viser.transforms as tf

    (client,) = bench._server.get_clients().values()
    seen = tf.SO3(client.camera.wxyz).inverse() @ (point - client.camera.position)
    focal = rect["height"] / 2 / np.tan(client.camera.fov / 2)
    return (
        rect["x"] + rect["width"] / 2 + focal * seen[0] / seen[2],
        rect["y"] + rect["height"] / 2 + focal * seen[1] / seen[2],
    )
