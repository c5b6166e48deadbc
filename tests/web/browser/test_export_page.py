"""Export in a real browser: options, progress and download; and the Statistics and Checks pages."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from browser_page import label_truth

from annotator.formats.rcv import read_rcv
from annotator.project import Effort, NewLabel, Project, WriteContext
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, AttributeKind, AttributeOf
from annotator.types import OrientedBox

if TYPE_CHECKING:
    from conftest import Shop
    from playwright.sync_api import Page

expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect


def test_a_dataset_is_exported_and_downloaded(
    shared_page: Page, shop: Shop, own_copy: Callable[[str], Path], tmp_path: Path
) -> None:
    """The unreadable frame is left out, as chosen, and the page names it."""
    page, recording, room = shared_page, own_copy("people"), shop.new_project()
    room.recordings.move(1, recording, [frame.key for frame in room.frames.of()], "Ada")
    page.goto(f"/#/{room.path.name}/export")
    expect(page.get_by_test_id("export-start")).to_be_disabled()
    expect(page.get_by_text("No boxes are accepted yet")).to_be_visible()
    chosen = label_truth(room, recording, 3)
    count = chosen - len(room.labels.of_frame(room.frames.of()[0].id))
    (recording / "depth/000000.png").write_bytes(b"")
    page.reload()
    expect(page.get_by_test_id("export-note")).to_contain_text(f"{chosen} boxes")
    page.get_by_test_id("export-skip-unreadable").check()
    page.get_by_test_id("export-start").click()
    expect(page.get_by_test_id("job-export-text")).to_contain_text(f"{count} boxes")
    expect(page.get_by_test_id("export-lost")).to_contain_text("1 frame cannot be read and was left out")
    unreadable = page.get_by_test_id("export-unreadable").locator("li")
    expect(unreadable).to_contain_text("people/depth/000000.png: the file is empty")
    expect(unreadable).not_to_contain_text(str(tmp_path))
    page.reload()  # the page shows the job and its file again
    with page.expect_download() as downloading:
        page.get_by_test_id("download").click()
    packed = tmp_path / "dataset.zip"
    downloading.value.save_as(packed)
    with zipfile.ZipFile(packed) as archive:
        archive.extractall(tmp_path / "dataset")
    (folder,) = (tmp_path / "dataset").iterdir()
    dataset = read_rcv(folder)
    assert dataset.manifest.counts.objects == count
    assert dataset.manifest.counts.frames == 2
    jobs = shop.live.context.jobs
    (job,) = (job for job in jobs.all() if job.project == room.path.name)
    jobs.file(job.id).unlink()
    jobs._tidy()
    expect(page.get_by_test_id("download-gone")).to_have_text("The dataset is no longer kept. Export it again.")
    expect(page.get_by_test_id("download")).to_have_count(0)
    # parts of the dataset
    page.get_by_test_id("export-skip-unreadable").check()
    page.get_by_test_id("export-divide").check()
    page.get_by_test_id("export-shares").fill("train")
    page.get_by_test_id("export-start").click()
    expect(page.get_by_test_id("export-form").get_by_role("alert")).to_contain_text("train=0.8,val=0.2")
    page.get_by_test_id("export-shares").fill("train=1,val=1")
    page.get_by_test_id("export-start").click()
    expect(page.get_by_test_id("export-parts")).to_contain_text("train: 2 frames")


def test_statistics_follow_the_work_and_checks_lead_to_its_boxes(shared_page: Page, shop: Shop, room: Project) -> None:
    page, frames = shared_page, room.frames.of()
    floors = Attribute(name="floor", kind=AttributeKind.INTEGER)
    room.change_classes(lambda config: edit.put_attribute(config, floors), "Ada")
    number = label_truth(room, shop.recording, 2)
    box = OrientedBox.from_parts(np.array([0.0, 0.0, 3.0]), np.eye(3), np.array([0.5, 0.5, 1.7]))
    made = [NewLabel("person", box, attributes={"floor": value}) for value in (1, 7, 7, *range(100, 111))]

    def create(labels: list[NewLabel], author: str, **more: object) -> None:
        context = WriteContext(room.frames.get(frames[0].id).revision, author, **more)
        room.labels.create(frames[0].id, labels, context)

    create(made, "Ada")
    # a chart must not take a name for HTML
    create([NewLabel("person", box)], "<b>Bo</b>", effort=Effort(3, 7.0))
    total = number + len(made) + 1
    page.goto(f"/#/{room.path.name}/statistics")
    statistics = shop.live.client.get(f"/api/projects/{room.path.name}/statistics").json()
    assert statistics["labels"]["total"] == total
    row = page.get_by_test_id("stats-states").locator("tr", has_text="person")
    expect(row.locator("td").last).to_have_text(str(total))
    for chart in ("work-days", "work-seconds", "work-ranges"):
        expect(page.get_by_test_id(chart).locator(".plot-container")).to_be_visible()
    row = page.get_by_test_id("stats-attributes").locator("tbody tr")
    most = ", ".join(["7: 2", "1: 1", *(f"{value}: 1" for value in range(100, 110))])
    expect(row.locator("td")).to_have_text([f"{most}, 1 other value", f"{number + 1}"])
    cells = page.get_by_test_id("stats-people").locator("tr", has_text="<b>Bo</b>").locator("td")
    expect(cells.nth(1)).to_have_text("1")
    expect(cells.nth(3)).to_have_text("under 1 min")
    expect(page.get_by_test_id("work-days").locator(".legendtext", has_text="<b>Bo</b>")).to_be_visible()
    expect(page.get_by_test_id("stats-days").locator("td").first).to_contain_text("in under 1 min")
    create([NewLabel("person", box)], "<b>Bo</b>")
    expect(cells.nth(1)).to_have_text("2")
    # a warning opens its box in Review, or its frame in Label
    rain = Attribute(name="rain", kind=AttributeKind.BOOLEAN, of=AttributeOf.FRAME, required=True)
    room.change_classes(lambda config: edit.put_attribute(config, rain), "Ada")
    frame, other = (room.frames.get(each.id) for each in room.frames.of()[:2])
    nowhere = OrientedBox.from_parts(np.array([0.0, -4.0, 3.0]), np.eye(3), np.array([0.5, 0.5, 1.7]))
    made = room.labels.create(frame.id, [NewLabel("person", nowhere)], WriteContext(frame.revision, "Ada"))
    room.frames.finalise(other.id, WriteContext(other.revision, "Ada"))
    page.goto(f"/#/{room.path.name}/checks")
    page.get_by_test_id("checks-empty").locator(f'[data-uid="{made.uids[0]}"]').click()
    selected = page.locator('[data-testid="frame-box"][aria-current="true"]')
    expect(selected).to_have_attribute("data-uid", made.uids[0])
    page.goto(f"/#/{room.path.name}/checks")
    link = page.get_by_test_id("checks-attribute").get_by_test_id("warning").filter(has_text="000001")
    expect(link).to_contain_text("this frame has no value of rain, which is required")
    link.click()
    expect(page).to_have_url(re.compile(rf"/label/{other.id}$"))
