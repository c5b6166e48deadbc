"""Export in a real browser: choose, start, watch, download; and the pages that say how far a project is."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from annotator.formats.rcv import read_rcv
from annotator.project import Change, NewLabel, Project
from annotator.recordings import open_recording
from annotator.types import OrientedBox
from annotator.workflows.truth import load_truth

if TYPE_CHECKING:
    from live_server import Live
    from playwright.sync_api import Page

expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect


def label_truth(project: Project, recording: Path, frames: int) -> int:
    """Accepted boxes of all objects in the first frames; how many there are."""
    opened = open_recording(recording)
    made = 0
    for index, stored in enumerate(project.frames.of()[:frames]):
        truths = load_truth(opened, index, opened.frame(index))
        labels = [NewLabel(truth.label, truth.box, track_id=truth.track_id) for truth in truths]
        made += len(project.labels.create(stored.id, labels, Change(stored.revision, "Ada")).uids)
    return made


@pytest.fixture
def signed_in(open_page: Callable[..., Page], live: Live) -> Page:
    page = open_page()
    answer = page.request.post("/api/session", data={"operator": "Ada"}, headers={"Origin": live.url})
    assert answer.ok
    return page


def test_nothing_to_export_says_what_to_do_next(signed_in: Page) -> None:
    signed_in.goto("/#/room/export")
    expect(signed_in.get_by_test_id("export-start")).to_be_disabled()
    expect(signed_in.get_by_text("No box is accepted yet")).to_be_visible()


def test_a_dataset_is_made_and_downloaded(signed_in: Page, live: Live, generated: Path, tmp_path: Path) -> None:
    count = label_truth(live.context.project("room"), generated / "people", 2)
    signed_in.goto("/#/room/export")
    expect(signed_in.get_by_test_id("export-note")).to_contain_text(f"{count} boxes")
    signed_in.get_by_test_id("export-start").click()
    expect(signed_in.get_by_test_id("job-export-text")).to_contain_text(f"{count} boxes", timeout=60_000)
    signed_in.reload()  # the job and its file are still known
    with signed_in.expect_download() as downloading:
        signed_in.get_by_test_id("download").click()
    packed = tmp_path / "dataset.zip"
    downloading.value.save_as(packed)
    with zipfile.ZipFile(packed) as archive:
        archive.extractall(tmp_path / "dataset")
    (folder,) = (tmp_path / "dataset").iterdir()
    dataset = read_rcv(folder)
    assert dataset.manifest.counts.objects == count
    assert dataset.manifest.counts.frames == 2
    (job,) = live.context.jobs.all()
    live.context.jobs.file(job.id).unlink()
    live.context.jobs._tidy()
    expect(signed_in.get_by_test_id("download-gone")).to_have_text("The dataset is no longer kept; export again.")
    expect(signed_in.get_by_test_id("download")).to_have_count(0)


def test_statistics_say_what_the_server_says(signed_in: Page, live: Live, generated: Path) -> None:
    count = label_truth(live.context.project("room"), generated / "people", 2)
    signed_in.goto("/#/room/statistics")
    told = live.client.get("/api/projects/room/statistics").json()
    assert told["labels"]["total"] == count
    row = signed_in.get_by_test_id("stats-states").locator("tr", has_text="person")
    expect(row.locator("td").last).to_have_text(str(count))
    expect(signed_in.locator(".chart .plot-container").first).to_be_visible(timeout=30_000)


def test_a_warning_opens_its_box_in_review(signed_in: Page, live: Live, generated: Path) -> None:
    project = live.context.project("room")
    label_truth(project, generated / "people", 2)
    frame = project.frames.of()[0]
    nowhere = OrientedBox.from_parts(np.array([0.0, -4.0, 3.0]), np.eye(3), np.array([0.5, 0.5, 1.7]))
    made = project.labels.create(frame.id, [NewLabel("person", nowhere)], Change(frame.revision, "Ada"))
    signed_in.add_init_script("HTMLCanvasElement.prototype.getContext = () => null;")
    signed_in.goto("/#/room/checks")
    signed_in.get_by_test_id("checks-empty").locator(f'[data-uid="{made.uids[0]}"]').click()
    selected = signed_in.locator('[data-testid="frame-box"][aria-current="true"]')
    expect(selected).to_have_attribute("data-uid", made.uids[0])
