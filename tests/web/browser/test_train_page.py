"""Train and propose in a real browser: what there is to learn from, a very small training, its proposals."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from browser_page import label_truth

from annotator.project import Project

if TYPE_CHECKING:
    from playwright.sync_api import Page

expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect


def test_nothing_to_learn_from_says_what_to_do_next(signed_in: Page, room: Project) -> None:
    signed_in.goto(f"/#/{room.path.name}/train")
    expect(signed_in.get_by_text("There are no boxes to learn from yet")).to_be_visible()
    expect(signed_in.get_by_test_id("train-start")).to_be_hidden()
    expect(signed_in.get_by_test_id("propose-start")).to_be_disabled()


def test_bad_settings_are_told_where_they_are(signed_in: Page, room: Project, generated: Path) -> None:
    label_truth(room, generated / "people", 1)
    signed_in.goto(f"/#/{room.path.name}/train")
    signed_in.get_by_test_id("train-role-image").uncheck()
    signed_in.get_by_test_id("train-role-view").uncheck()
    signed_in.get_by_test_id("train-start").click()
    expect(signed_in.get_by_role("alert")).to_have_text("Choose at least one detector to train.")


@pytest.mark.slow
def test_a_training_is_watched_and_another_one_stopped(signed_in: Page, room: Project, generated: Path) -> None:
    page = signed_in
    count = label_truth(room, generated / "people", 2)
    page.goto(f"/#/{room.path.name}/train")
    expect(page.get_by_test_id("material-image")).to_contain_text(f"{count} reviewed 3D boxes")
    page.get_by_text("Settings").click()
    page.get_by_test_id("train-role-view").uncheck()
    page.get_by_test_id("train-pictures-image").fill("16")
    page.get_by_test_id("train-size-image").fill("64")
    page.get_by_test_id("train-start").click()
    expect(page.get_by_test_id("stop-train")).to_be_visible(timeout=30_000)
    expect(page.get_by_test_id("job-indicator")).to_be_visible()
    page.reload()  # it goes on, and the page finds it again
    expect(page.get_by_test_id("curves-losses").locator(".plot-container")).to_be_visible(timeout=200_000)
    expect(page.get_by_test_id("job-train-text")).to_contain_text("trained", timeout=300_000)
    expect(page.locator('[data-testid="model-row"][data-active="true"]')).to_have_count(1, timeout=30_000)
    expect(page.get_by_test_id("material-image")).not_to_contain_text("nothing yet")
    expect(page.get_by_test_id("material-view")).to_contain_text("nothing yet")

    page.get_by_test_id("train-role-image").uncheck()
    page.get_by_test_id("train-start").click()
    page.get_by_test_id("stop-train").click()
    expect(page.get_by_test_id("job-train-text")).to_contain_text("topped", timeout=60_000)
    expect(page.get_by_test_id("train-start")).to_be_enabled()
    expect(page.get_by_test_id("propose-start")).to_be_disabled()
