"""The whole workflow in the workbench, without a terminal: from an empty projects folder to a downloaded dataset.
Everything is done with mouse and keyboard, in one browser with the 3D view, on a generated recording. The ground truth
determines where to drag and what to accept, and measures the downloaded boxes. The training is too short to be useful,
and proposals come from perfect detectors, since the result of a training depends on the processor; `benchmarks.loop`
measures it.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from drawing import Scene
from label_bench import Bench
from live_server import ended, running

from annotator.formats.rcv import read_rcv
from annotator.geometry.iou import iou_3d
from annotator.project import Project
from annotator.types import ReviewState, Truth
from annotator.web.jobs.records import WORK
from annotator.web.security import ServerSettings

if TYPE_CHECKING:
    from live_server import Live
    from playwright.sync_api import Page, Response

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed; run scripts/setup test")
expect = playwright.expect

LABELLED = (0, 4)
TRAINING = {"pictures-image": 16, "pictures-view": 24, "size-image": 64, "size-view": 64}
TRAINED_WITHIN_MS = 540_000.0
RIGHT = 0.5


@pytest.fixture
def live(tmp_path: Path, generated: Path) -> Iterator[Live]:
    """A server without projects that may access the generated recordings."""
    with running(ServerSettings(tmp_path / "projects", (generated,), port=0)) as server:
        yield server


def begins_job(answer: Response) -> bool:
    return answer.request.method == "POST" and answer.url.endswith("/jobs")


@dataclass(eq=False)
class Operator:
    """A simulated operator of the page who knows the ground truth."""

    page: Page
    live: Live
    scenes: list[Scene]

    @property
    def project(self) -> Project:
        return self.live.context.project("crowd")

    def click(self, test_id: str) -> None:
        self.page.get_by_test_id(test_id).click()

    def sign_in(self, name: str) -> None:
        self.page.goto("/")
        self.page.get_by_test_id("operator-name").fill(name)
        self.page.keyboard.press("Enter")
        self.page.get_by_test_id("no-projects").wait_for()

    def make_project(self, folder: str) -> None:
        self.page.get_by_test_id("new-project").first.click()
        self.page.get_by_test_id("project-name").fill("crowd")
        self.page.get_by_test_id("project-classes").fill("person")
        self.click("dialog-create")
        self.click(f"folder-{folder}")
        self.page.get_by_test_id("own-labels").uncheck()
        self.click("add-people")
        expect(self.page.get_by_test_id("added-recording")).to_contain_text("5 frames")
        self.page.keyboard.press("Escape")
        self.click("open-crowd")

    def label_frames(self) -> int:
        """Draws all visible objects of the frames to label; returns their number."""
        self.page.get_by_test_id("order").select_option("time")
        drawn = 0
        for index in LABELLED:
            self.go_to_frame(index)
            for number in range(len(self.scenes[index].objects)):
                Bench(self.page, self.live, self.project, self.scenes[index]).draw_object(number)
                drawn += 1
            expect(self.page.get_by_test_id("object")).to_have_count(len(self.scenes[index].objects))
        return drawn

    def go_to_frame(self, index: int) -> None:
        position = self.page.get_by_test_id("frame-position")
        expect(position).to_contain_text("/")
        for _ in self.scenes:
            shown = int(position.inner_text().split("/")[0])
            if shown == index + 1:
                break
            self.page.keyboard.press("n" if shown <= index else "p")
            expect(position).not_to_have_text(f"{shown} / {len(self.scenes)}")
        expect(position).to_have_text(f"{index + 1} / {len(self.scenes)}")
        self.page.get_by_test_id("image-editor").locator("img.picture[src]").wait_for()

    def train(self) -> None:
        self.click("mode-train")
        self.page.get_by_text("Settings", exact=True).click()
        for name, number in TRAINING.items():
            self.page.get_by_test_id(f"train-{name}").fill(str(number))
        self.click("train-start")
        self.page.get_by_test_id("curves-losses").locator(".plot-container").wait_for(timeout=TRAINED_WITHIN_MS)
        self.page.get_by_test_id("curves-quality").locator(".main-svg").first.wait_for(timeout=TRAINED_WITHIN_MS)
        self.finish_job("train")
        # with so few objects on held-out frames, the base detector stays in place of the new view detector
        expect(self.page.locator('[data-testid="model-row"][data-active="true"]')).to_have_count(1)
        expect(self.page.get_by_test_id("material-image")).not_to_contain_text("nothing yet")

    def propose(self) -> None:
        with self.page.expect_response(begins_job) as answer:
            self.click("propose-start")
        done = ended(self.live, answer.value.json())
        assert done["state"] == "done", done["message"]
        self.click("review-proposals")

    def finish_job(self, kind: str) -> None:
        line = self.page.get_by_test_id(f"job-{kind}")
        self.page.locator(
            f'[data-testid="job-{kind}"]:is([data-state="done"], [data-state="failed"], [data-state="cancelled"])'
        ).wait_for(timeout=TRAINED_WITHIN_MS)
        assert line.get_attribute("data-state") == "done", line.inner_text()

    def review(self) -> dict[str, int]:
        """Reviews the queue: accepts correct boxes, rejects false positives, and corrects the others."""
        done = {"accepted": 0, "corrected": 0, "rejected": 0}
        self.page.get_by_test_id("queue-item").first.wait_for()
        while int(self.page.get_by_test_id("queue-remaining").inner_text().split()[0]):
            uid = self.selected()
            stored = self.project.labels.get(uid)
            truth, overlap = self.nearest(stored.frame_id, uid)
            if overlap >= RIGHT:
                self.page.keyboard.press("Space")
                done["accepted"] += 1
            elif overlap < 0.05:
                self.page.keyboard.press("x")
                done["rejected"] += 1
            else:
                self.correct(truth)
                self.page.keyboard.press("Space")
                done["corrected"] += 1
            self.wait_until_decided(uid)
        return done

    def selected(self) -> str:
        row = self.page.locator('[data-testid="frame-box"][aria-current="true"]')
        row.wait_for()
        # keys have no effect while a frame is being opened
        expect(self.page.get_by_test_id("saving")).to_have_text("")
        uid = row.get_attribute("data-uid")
        assert uid is not None
        return uid

    def nearest(self, frame_id: int, uid: str) -> tuple[Truth, float]:
        box = self.project.labels.get(uid).label.box
        index = self.project.frames.get(frame_id).index
        assert index is not None
        truths = [Truth(item.label, item.box) for item in self.scenes[index].objects]
        overlaps = [iou_3d(box, truth.box) for truth in truths]
        best = int(np.argmax(overlaps))
        return truths[best], overlaps[best]

    def correct(self, truth: Truth) -> None:
        """Enters the object's true position and size."""
        for name, value in zip(("x", "y", "z"), truth.box.center_m, strict=True):
            self.page.get_by_test_id(f"field-center-{name}").fill(f"{value:.3f}")
        for name, value in zip(("length", "width", "height"), truth.box.size_m, strict=True):
            self.page.get_by_test_id(f"field-size-{name}").fill(f"{value:.3f}")
        self.page.keyboard.press("Enter")
        self.page.get_by_test_id("field-size-height").blur()
        expect(self.page.get_by_test_id("label-state")).to_have_text("edited")

    def wait_until_decided(self, uid: str) -> None:
        for _ in range(200):
            if self.project.labels.get(uid).label.state is not ReviewState.PROPOSED:
                break
            self.page.wait_for_timeout(50)
        expect(self.page.locator(f'[data-testid="queue-item"][data-uid="{uid}"]')).to_have_count(0)
        expect(self.page.get_by_test_id("saving")).to_have_text("")

    def export(self, out: Path) -> Path:
        self.click("mode-export")
        self.click("export-start")
        self.finish_job("export")
        with self.page.expect_download() as download:
            self.click("download")
        archive = out / "dataset.zip"
        download.value.save_as(archive)
        with zipfile.ZipFile(archive) as opened:
            opened.extractall(out / "dataset")
        return next((out / "dataset").rglob("dataset.json")).parent


@pytest.mark.slow
@pytest.mark.timeout(1500)
@pytest.mark.usefixtures("jobs_on_path")
def test_from_an_empty_folder_to_a_downloaded_dataset(
    open_page: Callable[[], Page], live: Live, generated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenes = [Scene.of(generated / "people", index, ("person",)) for index in range(5)]
    operator = Operator(open_page(), live, scenes)
    operator.sign_in("Ada")
    operator.make_project(generated.name)
    drawn = operator.label_frames()
    monkeypatch.setitem(WORK, "train", "knowing_jobs:train")
    operator.train()
    monkeypatch.setitem(WORK, "propose", "knowing_jobs:propose")
    operator.propose()
    decided = operator.review()
    assert decided["accepted"] > 0, decided
    dataset = read_rcv(operator.export(tmp_path))

    ious: list[float] = []
    for number in range(len(dataset)):
        labels = dataset.labels(number)
        scene = scenes[dataset.place(number)[1]]
        boxes = [label.box for label in labels]
        assert {label.author for label in labels} == {"Ada"}
        ious += [max(iou_3d(box, item.box) for item in scene.objects) for box in boxes]
    assert len(ious) == drawn + decided["accepted"] + decided["corrected"]
    assert np.mean(ious) > 0.6, sorted(ious)
    assert min(ious) > 0.25, sorted(ious)

    effort = live.client.get("/api/projects/crowd/statistics").json()["effort"]["by_origin"]
    assert effort["from nothing"]["actions_a_box"] == 5
    assert effort["proposal accepted untouched"]["actions_a_box"] == 1
