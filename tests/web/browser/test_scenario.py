"""The whole workflow in the workbench, without a terminal: from an empty projects folder to a downloaded dataset.

Everything is done with mouse and keyboard, in one browser with the 3D view, on a generated recording. The ground truth
determines where to drag, and measures the downloaded boxes. The training is too short to be useful, and proposals come
from perfect detectors, since the result of a training depends on the processor; `benchmarks.loop` measures it.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from browser_page import Bench
from drawing import Scene
from live_server import ended, running

from annotator.formats.rcv import read_rcv
from annotator.geometry.iou import iou_3d
from annotator.web.jobs.records import WORK
from annotator.web.security import ServerSettings

if TYPE_CHECKING:
    from live_server import Live
    from playwright.sync_api import Page

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed; run scripts/setup test")
expect = playwright.expect

LABELLED = (0, 4)
TRAINING = {"minutes": 1, "size-image": 64, "size-view": 64}
TRAINED_WITHIN_MS = 540_000.0


@pytest.fixture
def live(tmp_path: Path, generated: Path) -> Iterator[Live]:
    """A server without projects that may access the generated recordings."""
    with running(ServerSettings(tmp_path / "projects", (generated,), port=0)) as server:
        yield server


def go_to_frame(page: Page, index: int) -> None:
    position = page.get_by_test_id("frame-position")
    expect(position).to_contain_text("/")
    while (shown := int(position.inner_text().split("/")[0])) != index + 1:
        page.keyboard.press("n" if shown <= index else "p")
        expect(position).not_to_have_text(f"{shown} / 5")
    page.get_by_test_id("image-editor").locator("img.picture[src]").wait_for()


def finish_job(page: Page, kind: str) -> None:
    line = page.get_by_test_id(f"job-{kind}")
    expect(line).to_have_attribute("data-state", "done", timeout=TRAINED_WITHIN_MS)


@pytest.mark.slow
@pytest.mark.timeout(1500)
@pytest.mark.usefixtures("jobs_on_path")
def test_from_an_empty_folder_to_a_downloaded_dataset(
    open_page: Callable[[], Page], live: Live, generated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page, scenes = open_page(), [Scene.of(generated / "people", index, ("person",)) for index in range(5)]
    get, jobs = page.get_by_test_id, "/api/projects/crowd/jobs"
    page.goto("/")
    get("operator-name").fill("Ada")
    page.keyboard.press("Enter")
    get("no-projects").wait_for()
    get("new-project").first.click()
    get("project-name").fill("crowd")
    get("project-classes").fill("person")
    get("dialog-create").click()
    get(f"folder-{generated.name}").click()
    get("own-labels").uncheck()
    get("add-people").click()
    expect(get("added-recording")).to_contain_text("5 frames")
    page.keyboard.press("Escape")
    get("open-crowd").click()

    # all visible objects of two frames are drawn
    get("views-pseudo").click()
    drawn = 0
    for index in LABELLED:
        go_to_frame(page, index)
        for number in range(len(scenes[index].objects)):
            Bench(page, live, live.context.project("crowd"), scenes[index]).draw_object(number)
            drawn += 1
        expect(get("frame-box")).to_have_count(len(scenes[index].objects))

    monkeypatch.setitem(WORK, "train", "knowing_jobs:train")
    get("mode-train").click()
    page.get_by_text("Settings", exact=True).click()
    for name, value in TRAINING.items():
        get(f"train-{name}").fill(str(value))
    get("train-start").click()
    get("curves-losses").locator(".plot-container").wait_for(timeout=TRAINED_WITHIN_MS)
    get("curves-quality").locator(".main-svg").first.wait_for(timeout=TRAINED_WITHIN_MS)
    finish_job(page, "train")
    # with so few objects on held-out frames, the base detector stays in place of the new view detector
    expect(page.locator('[data-testid="model-row"][data-active="true"]')).to_have_count(1)
    # the trained detectors run; they are not expected to find anything
    for model in live.client.get("/api/projects/crowd/models").json()["models"]:
        assert "box_loss" in model["curves"][0]["metrics"]
        assert live.client.get(model["pictures"][0]).content[:2] == b"\xff\xd8"
        live.client.post(f"/api/projects/crowd/models/{model['id']}/activate")
    done = ended(live, live.client.post(jobs, json={"kind": "propose", "limit": 2}).json())
    assert (done["state"], done["result"]["frames"]) == ("done", 2), done["message"]

    monkeypatch.setitem(WORK, "propose", "knowing_jobs:propose")
    with page.expect_response(lambda answer: answer.request.method == "POST" and answer.url.endswith("/jobs")) as begun:
        get("propose-start").click()
    done = ended(live, begun.value.json())
    assert done["state"] == "done", done["message"]
    get("review-proposals").click()
    accepted = 0
    get("queue-item").first.wait_for()
    while get("queue-item").count():
        row = page.locator('[data-testid="frame-box"][aria-current="true"]')
        row.wait_for()
        expect(get("saving")).to_have_text("")
        item = page.locator(f'[data-testid="queue-item"][data-uid="{row.get_attribute("data-uid")}"]')
        page.keyboard.press("Space")
        expect(item).to_have_count(0)
        accepted += 1

    get("mode-export").click()
    get("export-start").click()
    finish_job(page, "export")
    with page.expect_download() as download:
        get("download").click()
    download.value.save_as(tmp_path / "dataset.zip")
    with zipfile.ZipFile(tmp_path / "dataset.zip") as opened:
        opened.extractall(tmp_path / "dataset")
    dataset = read_rcv(next((tmp_path / "dataset").rglob("dataset.json")).parent)
    frames = [(dataset.labelled(n)[1].truths, scenes[dataset.place(n)[1]]) for n in range(len(dataset))]
    written = [json.loads(dataset.label_path(n).read_text())["objects"] for n in range(len(dataset))]
    assert {entry["author"] for entries in written for entry in entries} == {"Ada"}
    ious = [max(iou_3d(each.box, item.box) for item in scene.objects) for truths, scene in frames for each in truths]
    assert len(ious) == drawn + accepted and accepted > 0
    assert np.mean(ious) > 0.6 and min(ious) > 0.25, sorted(ious)
    effort = live.client.get("/api/projects/crowd/statistics").json()["effort"]["by_origin"]
    assert effort["from nothing"]["actions_a_box"] == 5
    assert effort["proposal accepted untouched"]["actions_a_box"] == 1
