"""Review mode in a real browser: the page, its project, and proposals to review."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from browser_page import drag
from scipy.spatial.transform import Rotation

from annotator.geometry.outline import box_on_image
from annotator.project import Project, WriteContext
from annotator.recordings import open_recording
from annotator.types import Label, OrientedBox, Proposal, Quality, Source
from annotator.workflows.recorded.reading import load_truth

if TYPE_CHECKING:
    from conftest import Shop
    from live_server import Live
    from playwright.sync_api import Locator, Page

FRAMES = 3


@dataclass(eq=False)
class Desk:
    """A page in Review mode, and its project."""

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
        return int(self.page.url.split("/review/")[1].split("?")[0])

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
    """Opens Review mode of a new project with proposals; the most doubtful one is selected."""
    project = shop.new_project("proposed")
    page.goto(f"/#/{project.path.name}/review")
    desk = Desk(page, shop.live, project)
    page.locator(f"[data-testid=review-image] img.picture[src*='/{desk.name}/']").wait_for()
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
