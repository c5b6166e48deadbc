"""Train in a real browser: training data, errors, and stopping a training; `test_scenario` completes one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from browser_page import label_truth

from annotator.project import Project

if TYPE_CHECKING:
    from playwright.sync_api import Page

expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect


def test_without_boxes_the_page_says_what_to_do_next(signed_in: Page, room: Project) -> None:
    signed_in.goto(f"/#/{room.path.name}/train")
    expect(signed_in.get_by_text("There are no boxes to train on yet")).to_be_visible()
    expect(signed_in.get_by_test_id("train-start")).to_be_hidden()
    expect(signed_in.get_by_test_id("propose-start")).to_be_disabled()


def test_invalid_settings_are_shown_as_an_error(signed_in: Page, room: Project, generated: Path) -> None:
    label_truth(room, generated / "people", 1)
    signed_in.goto(f"/#/{room.path.name}/train")
    signed_in.get_by_test_id("train-role-image").uncheck()
    signed_in.get_by_test_id("train-role-view").uncheck()
    signed_in.get_by_test_id("train-start").click()
    expect(signed_in.get_by_role("alert")).to_have_text("Choose at least one detector to train.")


@pytest.mark.slow
def test_a_running_training_is_shown_after_a_reload_and_can_be_stopped(
    signed_in: Page, room: Project, generated: Path
) -> None:
    page = signed_in
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
    expect(page.get_by_test_id("job-train-text")).to_contain_text("train the image detector")
    page.get_by_test_id("stop-train").click()
    expect(page.get_by_test_id("job-train-text")).to_contain_text("topped")
    expect(page.get_by_test_id("train-start")).to_be_enabled()
    expect(page.get_by_test_id("propose-start")).to_be_disabled()
