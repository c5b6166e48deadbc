"""Train in a real browser: settings, detectors, and stopping a training; `test_scenario` completes one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from browser_page import label_truth

from annotator.detection import pretrained
from annotator.project import Project
from annotator.types import BoxKind, DetectorKind
from annotator.web.jobs.runner import WorkerProcess
from annotator.workflows.training.held_out import Decision, Rival

if TYPE_CHECKING:
    from conftest import Shop
    from playwright.sync_api import Page

expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect

# a training gives way to all other programs
BEGINS_MS = 500_000.0


def test_training_is_set_up_and_a_detector_is_chosen(
    shared_page: Page,
    shop: Shop,
    room: Project,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    wait_for: Callable[[Callable[[], object]], None],
) -> None:
    page = shared_page
    page.goto(f"/#/{room.path.name}/train")
    expect(page.get_by_text("There are no boxes to train on yet")).to_be_visible()
    expect(page.get_by_test_id("train-start")).to_be_hidden()
    expect(page.get_by_test_id("propose-start")).to_be_disabled()

    label_truth(room, shop.recording, 1)
    page.reload()
    page.get_by_test_id("train-role-image").uncheck()
    page.get_by_test_id("train-role-view").uncheck()
    page.get_by_test_id("train-start").click()
    expect(page.get_by_role("alert")).to_have_text("Choose at least one detector to train.")

    # learning while labelling is switched on for the project
    every, switch = page.get_by_test_id("learn-every"), page.get_by_test_id("learn-switch")
    expect(switch).not_to_be_checked()
    every.fill("1000")
    with page.expect_response("**/models/learning"):
        switch.check()
    assert room.config.settings.learn_every == 1000
    page.reload()
    expect(switch).to_be_checked()
    expect(every).to_have_value("1000")
    with page.expect_response("**/models/learning"):
        switch.uncheck()
    assert room.config.settings.learn_every is None

    # what held-out frames decided is shown, and the base detector can be chosen
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path)
    folder = room.models_folder / "view" / "run"
    folder.mkdir(parents=True)
    for weights in (tmp_path / "detector.safetensors", folder / "detector.safetensors"):
        weights.write_bytes(b"weights")
    room.models.register(
        DetectorKind.VIEW, folder / "detector.safetensors", labels=("whole", "seen"), box_kind=BoxKind.BOX,
        metrics={"map50": 0.5}, fingerprint="f",
    )  # fmt: skip
    rivals = (Rival(name="base detector", mean_iou=0.5),)
    Decision(
        objects=7, frames=2, mean_iou=0.625, compared=rivals, started_from="", outcome="the best one, in use now"
    ).write(folder)
    page.reload()
    expect(page.get_by_test_id("held-out")).to_have_text("0.63 (7 objects)")
    expect(page.get_by_test_id("decision")).to_contain_text("newest detector 0.63, base detector 0.50")
    page.get_by_test_id("use-base").click()
    expect(page.get_by_test_id("base-row")).to_have_attribute("data-active", "true")
    assert room.models.active(DetectorKind.VIEW) is None
    page.get_by_test_id("use-model").click()
    expect(page.get_by_test_id("base-row")).to_have_attribute("data-active", "false")


@pytest.mark.slow
def test_a_running_training_is_shown_after_a_reload_and_can_be_stopped(
    shared_page: Page, room: Project, generated: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("annotator.web.jobs.runner.WorkerProcess", WorkerProcess)
    page = shared_page
    count = label_truth(room, generated / "people", 2)
    page.goto(f"/#/{room.path.name}/train")
    expect(page.get_by_test_id("material-image")).to_contain_text(f"{count} reviewed 3D boxes")
    page.get_by_text("Settings").click()
    page.get_by_test_id("train-role-view").uncheck()
    page.get_by_test_id("train-pictures-image").fill("5000")
    page.get_by_test_id("train-size-image").fill("64")
    page.get_by_test_id("train-start").click()
    expect(page.get_by_test_id("stop-train")).to_be_visible()
    expect(page.get_by_test_id("job-indicator")).to_be_visible()
    page.reload()  # the training continues, and the page shows it again
    expect(page.get_by_test_id("job-train-text")).to_contain_text("train the image detector", timeout=BEGINS_MS)
    page.get_by_test_id("stop-train").click()
    expect(page.get_by_test_id("job-train-text")).to_contain_text("topped", timeout=BEGINS_MS)
    expect(page.get_by_test_id("train-start")).to_be_enabled()
    expect(page.get_by_test_id("propose-start")).to_be_disabled()
