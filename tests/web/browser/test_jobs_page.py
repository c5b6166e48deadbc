"""Training, exports with statistics and checks, and files with boxes, in a real browser; `test_scenario` trains."""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from browser_page import label_truth, refuse, until
from room_api import coco

from annotator.detection import pretrained
from annotator.detection.pretrained import TITLE
from annotator.formats.rcv import read_rcv
from annotator.project import Effort, NewLabel, Project, WriteContext
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, AttributeKind, AttributeOf
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind, DetectorKind, OrientedBox
from annotator.web.jobs.records import WORK
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.training.held_out import Decision, Rival

if TYPE_CHECKING:
    from conftest import Shop
    from playwright.sync_api import Page


expect = pytest.importorskip("playwright.sync_api").expect


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


def test_a_dataset_is_exported_and_downloaded(
    shared_page: Page, shop: Shop, own_copy: Callable[[str], Path], tmp_path: Path
) -> None:
    """The unreadable frame is left out, as chosen, and the page names it."""
    page, recording, room = shared_page, own_copy("people"), shop.new_project()
    room.recordings.move({1: (recording, [frame.key for frame in room.frames.of()])})
    page.goto(f"/#/{room.path.name}/export")
    none = page.get_by_text("No boxes are accepted yet")
    expect(none).to_be_visible()
    expect(page.get_by_test_id("export-form")).to_be_hidden()
    # 2D boxes alone can be exported, in the formats that hold them
    box = Box2D("person", 10.0, 10.0, 60.0, 90.0)
    room.boxes.set_on_image(1, [box], BoxKind.BOX, WriteContext(0, "ann"))
    page.reload()
    expect(none).to_be_visible()
    expect(page.get_by_test_id("export-start")).to_be_disabled()
    page.get_by_test_id("export-format").select_option("yolo")
    expect(page.get_by_test_id("export-start")).to_be_enabled()
    page.get_by_test_id("export-format").select_option("rcv")
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
    room.change_classes(edit.PutAttribute(attribute=floors), "Ada")
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
    room.change_classes(edit.PutAttribute(attribute=rain), "Ada")
    frame, other = (room.frames.get(each.id) for each in room.frames.of()[:2])
    nowhere = OrientedBox.from_parts(np.array([0.0, -4.0, 3.0]), np.eye(3), np.array([0.5, 0.5, 1.7]))
    made = room.labels.create(frame.id, [NewLabel("person", nowhere)], WriteContext(frame.revision, "Ada"))
    room.frames.finalise(other.id, WriteContext(other.revision, "Ada"))
    page.goto(f"/#/{room.path.name}/checks")
    page.get_by_test_id("checks-empty").locator(f'[data-uid="{made.uids[0]}"]').click()
    selected = page.locator('[data-testid="frame-box"][aria-current="true"]')
    expect(selected).to_have_attribute("data-uid", made.uids[0])
    page.goto(f"/#/{room.path.name}/checks")
    link = page.get_by_test_id("checks-attribute").get_by_test_id("warning").filter(has_text="frame 2")
    expect(link).to_contain_text("this frame has no value of rain, which is required")
    link.click()
    expect(page).to_have_url(re.compile(rf"/annotate/{other.id}$"))


@pytest.mark.usefixtures("jobs_on_path")
def test_a_coco_file_becomes_proposals_and_a_bad_one_says_why(
    room: Project, start: Page, generated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = room.path.name
    (tmp_path / "base").mkdir()
    (tmp_path / "base" / "detector.safetensors").write_bytes(b"weights")
    with monkeypatch.context() as patch:
        patch.setitem(WORK, "boxes", "knowing_jobs:boxes")
        patch.setattr(pretrained, "FOLDER", tmp_path / "base")
        project, content = room, coco(generated)
        people = len(content["annotations"]) - 1
        (tmp_path / "boxes.json").write_text(json.dumps(content))
        start.get_by_test_id(f"import-boxes-{name}").click()
        dialog = start.get_by_test_id("boxes-dialog")
        expect(dialog).to_contain_text(f"measured by: {TITLE}")
        start.get_by_test_id("boxes-file").set_input_files(tmp_path / "boxes.json")
        expect(start.get_by_test_id("boxes-found")).to_contain_text(f"{people + 1} boxes on 2 images")
        expect(dialog).not_to_contain_text("replaces")
        expect(dialog).to_contain_text("Left out: 1 image without a frame of the same name, such as elsewhere.jpg")
        # a class of the same name in other letters is offered; another one is left out, or added
        expect(start.get_by_test_id("boxes-class-Person")).to_have_value("person")
        expect(start.get_by_test_id("boxes-class-dog")).to_have_value("")
        start.get_by_test_id("dialog-import").click()
        card = start.get_by_test_id(f"project-{name}")
        expect(card.get_by_test_id("job-import-text")).to_contain_text(f"{people} proposals in 2 frames")
        expect(card.get_by_test_id("job-import-text")).to_contain_text("skipped: 1 box of class dog")
        expect(card).to_contain_text(f"{people} proposed")
    drawn = project.boxes.on_images()
    # undone on the page, as one action
    start.goto(f"/#/{name}/annotate/{drawn[0].frame_id}")
    objects = start.get_by_test_id("object")
    expect(objects).to_have_count(len(drawn[0].boxes))
    start.keyboard.press("Control+z")
    expect(objects).to_have_count(0)
    assert project.boxes.on_images() == ()

    # what is wrong with a file is said, and a class that the project lacks can be added
    content = json.dumps(coco(generated))
    register_recording(room, open_recording(generated / "hands"))
    start.goto("/#/")
    start.get_by_test_id(f"import-boxes-{name}").click()
    dialog, file = start.get_by_test_id("boxes-dialog"), start.get_by_test_id("boxes-file")
    (tmp_path / "torn.json").write_text(content[:-40])
    file.set_input_files(tmp_path / "torn.json")
    expect(start.get_by_test_id("boxes-about").get_by_role("alert")).to_contain_text("torn.json:1: is not valid JSON")
    (tmp_path / "boxes.json").write_text(content)
    file.set_input_files(tmp_path / "boxes.json")
    expect(dialog).to_contain_text("could be of several recordings")
    start.get_by_test_id("boxes-recording").select_option(label=room.recordings.all()[0].name)
    # the file is read again; until then it cannot be imported
    expect(start.get_by_test_id("boxes-about")).to_contain_text("7 boxes on 2 images")
    expect(dialog).not_to_contain_text("could be of several recordings")
    start.get_by_test_id("boxes-class-Person").select_option(label="leave out")
    start.get_by_test_id("dialog-import").click()
    expect(dialog).to_contain_text("All classes are left out")
    start.get_by_test_id("boxes-class-dog").select_option(label="add the class dog")
    # a class that an earlier try has added is not added again
    refuse(start, f"projects/{room.path.name}/jobs")
    start.get_by_test_id("dialog-import").click()
    until(start, lambda: room.config.classes == ("person", "dog"))
    expect(dialog.get_by_role("alert")).not_to_be_empty()
    start.unroute(f"**/projects/{room.path.name}/jobs")
    start.get_by_test_id("dialog-import").click()
    imported = card.get_by_test_id("job-import-text")
    expect(imported).to_contain_text("imported as 2D boxes: 1 dog on 2 camera images")
    start.goto(f"/#/{room.path.name}/train")
    expect(start.get_by_test_id("lift")).to_contain_text("1 frame has 2D boxes on the image, but no 3D boxes")


def test_3d_boxes_of_two_detectors_are_proposed_and_their_sources_shown(
    room: Project, start: Page, tmp_path: Path
) -> None:
    project, name = room, room.path.name
    first, second = (frame.key for frame in project.frames.of()[:2])
    entry = {"label": "Person", "size": [0.5, 0.4, 1.8], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
    entry["attributes"] = {"age": 7}

    def propose(source: str, *boxes: tuple[float, float], lowest: str = "") -> None:
        given = [entry | {"center": [x, 0.0, 3.0], "score": score} for x, score in boxes]
        (tmp_path / f"{source}.json").write_text(json.dumps({first: given, second: [], "elsewhere": []}))
        start.get_by_test_id(f"import-boxes-{name}").click()
        dialog = start.get_by_test_id("boxes-dialog")
        start.get_by_test_id("boxes-file").set_input_files(tmp_path / f"{source}.json")
        expect(start.get_by_test_id("boxes-found")).to_contain_text(f"{len(boxes)} 3D boxes in 2 frames")
        expect(start.get_by_test_id("boxes-class-Person")).to_have_value("person")
        expect(start.get_by_test_id("boxes-source")).to_have_value(source)
        expect(dialog).to_contain_text("The scores are 0.2 to 0.8")
        start.get_by_test_id("boxes-become").select_option("labels")
        expect(start.get_by_test_id("boxes-source")).to_be_hidden()
        start.get_by_test_id("boxes-become").select_option("proposals")
        start.get_by_test_id("boxes-add-attributes").check()
        start.get_by_test_id("boxes-min-score").fill(lowest)
        start.get_by_test_id("dialog-import").click()
        expect(start.get_by_test_id(f"project-{name}")).to_contain_text(f"proposed by {source}: ")

    propose("mine", (0.0, 0.8), (0.6, 0.2))
    assert [each.name for each in project.config.attributes] == ["age"]
    propose("theirs", (0.02, 0.6), (-0.6, 0.8), (1.5, 0.2), lowest="0.3")
    start.goto(f"/#/{name}/annotate")
    items = start.get_by_test_id("queue-item")
    expect(items).to_have_count(3)
    expect(start.get_by_test_id("queue-said")).to_have_text(["mine", "mine +1", "theirs"])
    sources = start.get_by_test_id("queue-source")
    expect(sources.locator("option")).to_have_text(["All sources", "mine (2)", "theirs (2)"])
    sources.select_option("theirs")
    expect(start.get_by_test_id("queue-said")).to_have_text(["mine +1", "theirs"])
    expect(start.get_by_test_id("queue-remaining")).to_have_text("2 proposals")
    items.first.click()
    expect(start.get_by_text("mine: person 0.80, theirs: person 0.60")).to_be_visible()
    expect(start.get_by_title("Score: ")).to_have_attribute("title", "Score: 0.80, of mine")
