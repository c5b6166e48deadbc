"""Label mode in a real browser, as its tests use it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from browser_page import VIEWS, answers_drag, drag, drag_box, draw_on_views

from annotator.project import Project
from annotator.types import Label

if TYPE_CHECKING:
    from drawing import Scene
    from live_server import Live
    from playwright.sync_api import Page

FRAME = 1
EDGES = ("x_min", "y_min", "x_max", "y_max")


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
