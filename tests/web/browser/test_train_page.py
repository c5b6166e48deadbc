"""Train and propose in a real browser: what there is to learn from, a very small training, its proposals."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from test_export_page import label_truth

if TYPE_CHECKING:
    from conftest import Live
    from playwright.sync_api import Page

expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect


@pytest.fixture
def signed_in(open_page: Callable[..., Page], live: Live) -> Page:
    page = open_page()
    answer = page.request.post("/api/session", data={"operator": "Ada"}, headers={"Origin": live.url})
    assert answer.ok
    return page


def test_nothing_to_learn_from_says_what_to_do_next(signed_in: Page) -> None:
    signed_in.goto("/#/room/train")
    expect(signed_in.get_by_text("There are no boxes to learn from yet")).to_be_visible()
    expect(signed_in.get_by_test_id("train-start")).to_be_hidden()
    expect(signed_in.get_by_test_id("propose-start")).to_be_disabled()


def test_bad_settings_are_told_where_they_are(signed_in: Page, live: Live, generated: Path) -> None:
    label_truth(live.context.project("room"), generated / "people", 1)
    signed_in.goto("/#/room/train")
    signed_in.get_by_test_id("train-role-image").uncheck()
    signed_in.get_by_test_id("train-role-view").uncheck()
    signed_in.get_by_test_id("train-start").click()
    expect(signed_in.get_by_role("alert")).to_have_text("Choose at least one detector to train.")


@pytest.mark.slow
def test_train_watch_propose_and_go_on_to_review(signed_in: Page, live: Live, generated: Path) -> None:
    page = signed_in
    count = label_truth(live.context.project("room"), generated / "people", 4)
    page.goto("/#/room/train")
    expect(page.get_by_test_id("material-image")).to_contain_text(f"{count} reviewed 3D boxes")
    page.get_by_text("Settings").click()
    for role in ("image", "view"):
        page.get_by_test_id(f"train-pictures-{role}").fill("16")
        page.get_by_test_id(f"train-size-{role}").fill("64")
    page.get_by_test_id("train-start").click()
    expect(page.get_by_test_id("stop-train")).to_be_visible(timeout=30_000)
    expect(page.get_by_test_id("job-indicator")).to_be_visible()
    page.reload()  # it goes on, and the page finds it again
    expect(page.get_by_test_id("curves-losses").locator(".plot-container")).to_be_visible(timeout=200_000)
    expect(page.get_by_test_id("job-train-text")).to_contain_text("trained", timeout=300_000)
    expect(page.locator('[data-testid="model-row"][data-active="true"]')).to_have_count(2, timeout=30_000)
    expect(page.get_by_test_id("material-view")).not_to_contain_text("nothing yet")

    page.get_by_test_id("propose-limit").fill("1")
    page.get_by_test_id("propose-start").click()
    expect(page.get_by_test_id("job-propose-text")).to_contain_text("proposals in 1 frames", timeout=200_000)
    waiting = live.client.get("/api/projects/room").json()["labels_by_state"]["proposed"]
    if waiting:  # so small a training may find nothing
        expect(page.get_by_test_id("review-proposals")).to_contain_text(f"Review {waiting} proposal")
