"""Helpers of the tests in a real browser; see browser/conftest.py for the fixtures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from annotator.project import NewLabel, Project, WriteContext
from annotator.recordings import open_recording
from annotator.workflows.recorded.reading import load_truth

if TYPE_CHECKING:
    from drawing import Scene
    from playwright.sync_api import Page, Response

    from annotator.web.viewport.viewports import Viewport

POLL_MS = 50
VIEWS = ("front", "side", "front-2", "side-2")


def until(page: Page, condition: str | Callable[[], object], seconds: float = 120.0) -> None:
    """Waits until a JavaScript expression or a Python function is true.

    `Page.wait_for_function` evaluates a string within the page, which the page's content security policy forbids.
    """
    for _ in range(int(seconds * 1000 / POLL_MS)):
        if condition() if callable(condition) else page.evaluate(condition):
            return
        page.wait_for_timeout(POLL_MS)
    raise AssertionError(f"not within {seconds} s: {condition}")


def refuse(page: Page, path: str) -> None:
    """Blocks requests to paths with this ending, and waits until that has taken effect.

    Under load, a request right after `route` may still reach the server.
    """
    page.route(f"**/{path}", lambda route: route.abort())
    until(page, f"fetch('/refused/{path}').then(() => false, () => true)")


def sign_in(page: Page, url: str, operator: str = "Ada") -> None:
    """Signs in by a request, before the page is opened."""
    answer = page.request.post(f"{url}/api/session", data={"operator": operator}, headers={"Origin": url})
    assert answer.ok


def drag(page: Page, *points: tuple[float, float]) -> None:
    """Drags the mouse along the points."""
    page.mouse.move(*points[0])
    page.mouse.down()
    for point in points[1:]:
        page.mouse.move(*point)
    page.mouse.up()


def drag_box(page: Page, editor: str, box: dict[str, Any], width: int, height: int) -> None:
    """Draws a box on the image of an editor; (0, 0) is the centre of the image's first pixel."""
    picture = page.get_by_test_id(editor).locator("img.picture")
    rect = picture.evaluate("(img) => img.getBoundingClientRect().toJSON()")
    scale = np.array([rect["width"] / width, rect["height"] / height])
    corner = np.array([rect["left"], rect["top"]])
    start = corner + (np.array([box["x_min"], box["y_min"]]) + 0.5) * scale
    end = corner + (np.array([box["x_max"], box["y_max"]]) + 0.5) * scale
    drag(page, tuple(start), tuple((start + end) / 2), tuple(end))


def answers_drag(drawn: int) -> Callable[[Response], bool]:
    """True for the answer, in Label mode, to a change after which an object has this many boxes on its views."""

    def is_answer(response: Response) -> bool:
        if not response.url.endswith("/label/object"):
            return False
        boxes = response.request.post_data_json["object"]["boxes"]
        return sum(box is not None for box in boxes) == drawn

    return is_answer


def draw_on_views(page: Page, scene: Scene, number: int, views: Sequence[dict[str, Any]], step: int = 0) -> None:
    """Draws the boxes of a true object on the two views of a step."""
    for name, view in zip(VIEWS[2 * step :], views, strict=False):
        shown = page.get_by_test_id(f"view-{name}").locator(f'img.picture[src="{view["url"]}"]')
        shown.wait_for(state="attached")
        drag_box(page, f"view-{name}", scene.view_box(number, view), view["width"], view["height"])


def label_truth(project: Project, recording: Path, frames: int) -> int:
    """Creates accepted labels of all objects in the first frames; returns their number."""
    opened = open_recording(recording)
    count = 0
    for index, stored in enumerate(project.frames.of()[:frames]):
        truths = load_truth(opened, index, opened.frame(index))
        labels = [NewLabel(truth.label, truth.box, track_id=truth.track_id) for truth in truths]
        count += len(project.labels.create(stored.id, labels, WriteContext(stored.revision, "Ada")).uids)
    return count


def seen_by_viewer(viewport: Viewport, rect: dict[str, float], point: np.ndarray) -> tuple[float, float]:
    """Position on the page of a point in the camera frame, shown by a 3D viewport at `rect`."""
    import viser.transforms as tf

    (client,) = viewport._server.get_clients().values()
    seen = tf.SO3(client.camera.wxyz).inverse() @ (point - client.camera.position)
    focal = rect["height"] / 2 / np.tan(client.camera.fov / 2)
    return (
        rect["x"] + rect["width"] / 2 + focal * seen[0] / seen[2],
        rect["y"] + rect["height"] / 2 + focal * seen[1] / seen[2],
    )
