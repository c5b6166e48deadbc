"""What the tests in a real browser use: the mouse, a page with pseudo-views (`Bench`), one with proposals (`Desk`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from annotator.geometry.outline import box_on_image
from annotator.project import NewLabel, Project, WriteContext
from annotator.recordings import open_recording
from annotator.types import Label, OrientedBox, Proposal, Quality, Source
from annotator.workflows.recorded.reading import load_truth

if TYPE_CHECKING:
    from conftest import Shop
    from drawing import Scene
    from live_server import Live
    from playwright.sync_api import Locator, Page, Response

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
    """True for the answer to a change after which an object has this many boxes on its views."""

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


FRAME = 1
EDGES = ("x_min", "y_min", "x_max", "y_max")


@dataclass(eq=False)
class Bench:
    """A page that shows the pseudo-views, its project, and the true objects of its frame."""

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
        return self.page.get_by_test_id("image-note").inner_text()

    def saved(self) -> None:
        """Waits until all changes are saved."""
        self.page.wait_for_selector(".annotate:not([data-saving])")
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


FRAMES = 3


@dataclass(eq=False)
class Desk:
    """A page with proposals, and its project."""

    page: Page
    live: Live
    project: Project

    @property
    def name(self) -> str:
        """The project's name."""
        return self.project.path.name

    @property
    def api(self) -> str:
        """The URL path of the project's API."""
        return f"/api/projects/{self.name}"

    @property
    def frame(self) -> int:
        """The id of the shown frame."""
        return int(self.page.url.split("/annotate/")[1].split("?")[0])

    @property
    def uid(self) -> str:
        """The uid of the selected label."""
        row = self.page.locator('[data-testid="frame-box"][aria-current="true"]')
        uid = row.get_attribute("data-uid")
        assert uid is not None
        return uid

    @property
    def label(self) -> Label:
        """The selected label as it is stored."""
        return self.project.labels.get(self.uid).label

    def box(self, view: str) -> Locator:
        """The rectangle of the selected box in one of the views along its axes."""
        return self.page.get_by_test_id(f"ortho-{view}").locator("rect.line")

    def settled(self) -> None:
        """Waits until all changes are saved and the three views show the current box."""
        from playwright.sync_api import expect

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


def begin(page: Page, shop: Shop) -> Desk:
    """Opens a new project with proposals; the most doubtful one is selected."""
    project = shop.new_project("proposed")
    page.goto(f"/#/{project.path.name}/annotate")
    desk = Desk(page, shop.live, project)
    page.locator(f"[data-testid=image-editor] img.picture[src*='/{desk.name}/']").wait_for()
    desk.settled()
    return desk


def propose(project: Project, recording: Path, frames: int = FRAMES) -> None:
    """One proposal per true object, displaced from it: the further, the higher its doubt."""
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
        project.proposals.replace(stored.id, proposals, WriteContext(stored.revision, "detectors", Source.AUTO))


def middle(element: Locator) -> tuple[float, float]:
    """The centre of an element on the screen."""
    box = element.bounding_box()
    assert box is not None
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
