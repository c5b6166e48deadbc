"""Export in a real browser: options, progress and download; and the Statistics and Checks pages."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from browser_page import label_truth, sign_in

from annotator.formats.rcv import read_rcv
from annotator.project import Effort, NewLabel, Project, WriteContext
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, AttributeKind, AttributeOf
from annotator.types import BoxKind, OrientedBox

if TYPE_CHECKING:
    from conftest import Shop
    from playwright.sync_api import Page

expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect


def test_without_reviewed_boxes_the_page_says_what_to_do_next(signed_in: Page, room: Project) -> None:
    signed_in.goto(f"/#/{room.path.name}/export")
    expect(signed_in.get_by_test_id("export-start")).to_be_disabled()
    expect(signed_in.get_by_text("No boxes are accepted yet")).to_be_visible()


def test_a_dataset_is_exported_and_downloaded(
    signed_in: Page, shop: Shop, own_copy: Callable[[str], Path], tmp_path: Path
) -> None:
    """The unreadable frame is left out, as chosen, and the page names it."""
    recording = own_copy("people")
    room = shop.new_project(recording)
    chosen = label_truth(room, recording, 3)
    count = chosen - len(room.labels.of_frame(room.frames.of()[0].id))
    (recording / "depth/000000.png").write_bytes(b"")
    signed_in.goto(f"/#/{room.path.name}/export")
    expect(signed_in.get_by_test_id("export-note")).to_contain_text(f"{chosen} boxes")
    signed_in.get_by_test_id("export-skip-unreadable").check()
    signed_in.get_by_test_id("export-start").click()
    expect(signed_in.get_by_test_id("job-export-text")).to_contain_text(f"{count} boxes")
    expect(signed_in.get_by_test_id("export-lost")).to_contain_text("1 frame cannot be read and was left out")
    unreadable = signed_in.get_by_test_id("export-unreadable").locator("li")
    expect(unreadable).to_contain_text("people/depth/000000.png: the file is empty")
    expect(unreadable).not_to_contain_text(str(tmp_path))
    signed_in.reload()  # the page shows the job and its file again
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
    jobs = shop.live.context.jobs
    (job,) = jobs.all()
    jobs.file(job.id).unlink()
    jobs._tidy()
    expect(signed_in.get_by_test_id("download-gone")).to_have_text("The dataset is no longer kept. Export it again.")
    expect(signed_in.get_by_test_id("download")).to_have_count(0)


def test_the_losses_of_a_format_are_shown(shared_page: Page, shop: Shop, room: Project) -> None:
    page = shared_page
    label_truth(room, shop.recording, 2)
    sign_in(page, shop.live.url)
    page.goto(f"/#/{room.path.name}/export")
    page.get_by_test_id("export-format").select_option("coco")
    expect(page.get_by_test_id("export-pictures")).to_be_visible()
    page.get_by_test_id("export-format").select_option("kitti")
    expect(page.get_by_test_id("export-pictures")).to_be_hidden()
    page.get_by_test_id("export-divide").check()
    page.get_by_test_id("export-shares").fill("train")
    page.get_by_test_id("export-start").click()
    expect(page.get_by_test_id("export-form").get_by_role("alert")).to_contain_text("train=0.8,val=0.2")
    page.get_by_test_id("export-shares").fill("train=1,val=1")
    page.get_by_test_id("export-start").click()
    expect(page.get_by_test_id("export-parts")).to_contain_text("train: 1 frame")
    expect(page.get_by_test_id("export-lost")).to_contain_text("boxes have a track id")


def test_statistics_show_the_servers_numbers(signed_in: Page, shop: Shop, room: Project) -> None:
    count = label_truth(room, shop.recording, 2)
    signed_in.goto(f"/#/{room.path.name}/statistics")
    statistics = shop.live.client.get(f"/api/projects/{room.path.name}/statistics").json()
    assert statistics["labels"]["total"] == count
    row = signed_in.get_by_test_id("stats-states").locator("tr", has_text="person")
    expect(row.locator("td").last).to_have_text(str(count))
    for chart in ("work-days", "work-seconds", "work-ranges"):
        expect(signed_in.get_by_test_id(chart).locator(".plot-container")).to_be_visible()


def test_statistics_list_people_and_days_and_follow_the_work(signed_in: Page, shop: Shop, room: Project) -> None:
    frame = room.frames.of()[0]
    box = OrientedBox.from_parts(np.array([0.0, 0.0, 3.0]), np.eye(3), np.array([0.5, 0.5, 1.7]))
    # a chart must not take a name for HTML
    bo = WriteContext(frame.revision, "<b>Bo</b>", effort=Effort(3, 7.0))
    room.labels.create(frame.id, [NewLabel("person", box)], bo)
    room.boxes.set_on_image(frame.id, [], BoxKind.BOX, WriteContext(frame.revision + 1, "simulated operator"))
    signed_in.goto(f"/#/{room.path.name}/statistics")
    cells = signed_in.get_by_test_id("stats-people").locator("tr", has_text="<b>Bo</b>").locator("td")
    expect(cells.nth(1)).to_have_text("1")
    expect(cells.nth(3)).to_have_text("under 1 min")
    expect(signed_in.get_by_test_id("stats-people").locator("tbody th")).to_have_text(["<b>Bo</b>"])
    expect(signed_in.get_by_test_id("work-days").locator(".legendtext")).to_have_text("<b>Bo</b>")
    expect(signed_in.get_by_test_id("stats-days").locator("td").first).to_contain_text("1 in under 1 min")
    room.labels.create(frame.id, [NewLabel("person", box)], WriteContext(frame.revision + 2, "<b>Bo</b>"))
    expect(cells.nth(1)).to_have_text("2")


def test_statistics_list_the_values_of_attributes(signed_in: Page, shop: Shop, room: Project) -> None:
    number = label_truth(room, shop.recording, 2)
    floors = Attribute(name="floor", kind=AttributeKind.INTEGER)
    rain = Attribute(name="rain", kind=AttributeKind.BOOLEAN, of=AttributeOf.FRAME, default=False)
    unused = Attribute(name="helmet", kind=AttributeKind.BOOLEAN, of=AttributeOf.TRACK)
    for attribute in (floors, rain, unused):
        room.change_classes(lambda config, each=attribute: edit.put_attribute(config, each), "Ada")
    frames = room.frames.of()
    box = OrientedBox.from_parts(np.array([0.0, 0.0, 3.0]), np.eye(3), np.array([0.5, 0.5, 1.7]))
    made = [NewLabel("person", box, attributes={"floor": value}) for value in (1, 7, 7, *range(100, 111))]
    first = room.frames.get(frames[0].id)
    room.labels.create(first.id, made, WriteContext(first.revision, "Ada"))
    room.frames.set_attributes(frames[2].id, {"rain": True}, WriteContext(frames[2].revision, "Ada"))
    signed_in.goto(f"/#/{room.path.name}/statistics")
    rows = signed_in.get_by_test_id("stats-attributes").locator("tbody tr")
    expect(rows.locator("th")).to_have_text(["floor", "helmet", "rain"])
    most = ", ".join(["7: 2", "1: 1", *(f"{value}: 1" for value in range(100, 110))])
    numbers = [f"{most}, 1 other value", f"{number}", "none", f"{number + len(made)}"]
    expect(rows.locator("td")).to_have_text([*numbers, f"false: {len(frames) - 1}, true: 1", "0"])


def test_a_warning_about_a_frame_opens_it_in_label(signed_in: Page, room: Project) -> None:
    rain = Attribute(name="rain", kind=AttributeKind.BOOLEAN, of=AttributeOf.FRAME, required=True)
    room.change_classes(lambda config: edit.put_attribute(config, rain), "Ada")
    frame = room.frames.of()[1]
    room.frames.finalise(frame.id, WriteContext(frame.revision, "Ada"))
    signed_in.goto(f"/#/{room.path.name}/checks")
    link = signed_in.get_by_test_id("checks-attribute").get_by_test_id("warning")
    expect(link).to_contain_text("this frame has no value of rain, which is required")
    link.click()
    expect(signed_in).to_have_url(re.compile(rf"/label/{frame.id}$"))


def test_a_warning_opens_its_box_in_review(shared_page: Page, shop: Shop, room: Project) -> None:
    label_truth(room, shop.recording, 2)
    frame = room.frames.of()[0]
    nowhere = OrientedBox.from_parts(np.array([0.0, -4.0, 3.0]), np.eye(3), np.array([0.5, 0.5, 1.7]))
    made = room.labels.create(frame.id, [NewLabel("person", nowhere)], WriteContext(frame.revision, "Ada"))
    sign_in(shared_page, shop.live.url)
    shared_page.goto(f"/#/{room.path.name}/checks")
    shared_page.get_by_test_id("checks-empty").locator(f'[data-uid="{made.uids[0]}"]').click()
    selected = shared_page.locator('[data-testid="frame-box"][aria-current="true"]')
    expect(selected).to_have_attribute("data-uid", made.uids[0])
