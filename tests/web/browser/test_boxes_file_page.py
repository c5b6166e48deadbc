"""Boxes of a file, imported on the page: 2D boxes with 3D boxes proposed from them, and 3D boxes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from browser_page import refuse, until
from room_api import coco

from annotator.detection import pretrained
from annotator.detection.pretrained import TITLE
from annotator.project import Project, WriteContext
from annotator.project.changes import ImageBoxesSet
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind, ReviewState
from annotator.web.jobs.records import WORK
from annotator.workflows.add_recordings import register_recording

expect = pytest.importorskip("playwright.sync_api").expect

if TYPE_CHECKING:
    from playwright.sync_api import Page, Route


@pytest.mark.usefixtures("jobs_on_path")
def test_a_coco_file_becomes_proposals(
    room: Project, start: Page, generated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(WORK, "boxes", "knowing_jobs:boxes")
    name = room.path.name
    (tmp_path / "base").mkdir()
    (tmp_path / "base" / "detector.safetensors").write_bytes(b"weights")
    with monkeypatch.context() as patch:
        patch.setattr(pretrained, "FOLDER", tmp_path / "base")
        project, content = room, coco(generated)
        people = len(content["annotations"]) - 1
        (tmp_path / "boxes.json").write_text(json.dumps(content))
        start.get_by_test_id(f"import-boxes-{name}").click()
        dialog = start.get_by_test_id("boxes-dialog")
        expect(dialog).to_contain_text(f"measured by: {TITLE}")
        start.get_by_test_id("dialog-import").click()
        expect(dialog).to_contain_text("Choose a file with boxes first")
        start.get_by_test_id("boxes-file").set_input_files(tmp_path / "boxes.json")
        expect(start.get_by_test_id("boxes-found")).to_contain_text(f"{people + 1} boxes on 2 images")
        expect(dialog).not_to_contain_text("replaces")
        expect(dialog).to_contain_text("Left out: 1 image without a frame of the same name, such as elsewhere.jpg")
        # a class of the same name in other letters is offered; another one is left out, or added
        expect(start.get_by_test_id("boxes-class-Person")).to_have_value("person")
        expect(start.get_by_test_id("boxes-class-dog")).to_have_value("")
        start.get_by_test_id("boxes-class-dog").select_option(label="add the class dog")
        start.get_by_test_id("boxes-class-dog").select_option(label="leave out")
        start.get_by_test_id("dialog-import").click()
        card = start.get_by_test_id(f"project-{name}")
        expect(card.get_by_test_id("job-import-text")).to_contain_text(f"{people} proposals in 2 frames")
        expect(card.get_by_test_id("job-import-text")).to_contain_text("skipped: 1 box of class dog")
        expect(card).to_contain_text(f"{people} proposed")
    assert project.config.classes == ("person",)
    assert len(project.labels.select(states=[ReviewState.PROPOSED])) == people
    drawn = project.boxes.on_images()
    assert {boxes.author for boxes in drawn} == {"Grace"} and len(drawn) == 2
    # undone on the page, as one action
    start.goto(f"/#/{name}/label/{drawn[0].frame_id}")
    objects = start.get_by_test_id("object")
    expect(objects).to_have_count(len(drawn[0].boxes))
    start.keyboard.press("Control+z")
    expect(objects).to_have_count(0)
    assert project.boxes.on_images() == ()


def test_bad_files_say_why_a_class_can_be_added_and_a_file_is_awaited(
    room: Project, start: Page, generated: Path, tmp_path: Path
) -> None:
    project, content = room, coco(generated)
    start.goto(f"/#/{room.path.name}/train")
    start.get_by_test_id("import-boxes").click()
    about, file = start.get_by_test_id("boxes-about"), start.get_by_test_id("boxes-file")
    expect(start.get_by_test_id("boxes-lift")).to_be_disabled()
    for name, text, says in (
        ("notes.txt", "0 0.5", "notes.txt: is neither a file of boxes"),
        ("torn.json", json.dumps(content)[:-40], "torn.json:1: is not valid JSON"),
        ("other.json", json.dumps({**content, "images": content["images"][:1], "annotations": []}), "000012.jpg"),
    ):
        (tmp_path / name).write_text(text)
        file.set_input_files(tmp_path / name)
        expect(about.get_by_role("alert")).to_contain_text(says)
        start.get_by_test_id("dialog-import").click()
        expect(start.get_by_test_id("boxes-dialog")).to_contain_text("Choose a file with boxes first")
    assert project.boxes.on_images() == ()
    (tmp_path / "boxes.json").write_text(json.dumps(content))
    file.set_input_files(tmp_path / "boxes.json")
    start.get_by_test_id("boxes-class-Person").select_option(label="leave out")
    start.get_by_test_id("dialog-import").click()
    expect(start.get_by_test_id("boxes-dialog")).to_contain_text("All classes are left out")
    start.get_by_test_id("boxes-class-dog").select_option(label="add the class dog")
    # a class that an earlier try has added is not added again
    refuse(start, f"projects/{room.path.name}/jobs")
    start.get_by_test_id("dialog-import").click()
    expect(start.get_by_test_id("boxes-dialog").get_by_role("alert")).not_to_be_empty()
    until(start, lambda: project.config.classes == ("person", "dog"))
    start.unroute(f"**/projects/{room.path.name}/jobs")
    start.get_by_test_id("dialog-import").click()
    expect(start.get_by_test_id("job-boxes-text")).to_contain_text("imported as 2D boxes: 1 dog on 2 camera images")
    assert project.config.classes == ("person", "dog")
    assert sum(len(boxes.boxes) for boxes in project.boxes.on_images()) == 1
    expect(start.get_by_test_id("lift")).to_contain_text("1 frame has 2D boxes on the image, but no 3D boxes")

    # while a file is still read, another recording is chosen
    waiting: list[Route] = []
    register_recording(project, open_recording(generated / "hands"))
    first = project.recordings.all()[0]
    frame = project.frames.of([first.id])[0]
    drawn = ImageBoxesSet(boxes=(Box2D("person", 1.0, 2.0, 30.0, 40.0),), box_kind=BoxKind.SILHOUETTE)
    project.log.append(frame.id, [drawn], WriteContext(frame.revision, "Bob"))
    before = project.boxes.on_images()
    (tmp_path / "boxes.json").write_text(json.dumps(coco(generated, "person")))
    start.reload()
    start.get_by_test_id("import-boxes").click()
    dialog, found = start.get_by_test_id("boxes-dialog"), start.get_by_test_id("boxes-found")
    start.route("**/boxes-files?name=*", lambda route: waiting.append(route))
    start.get_by_test_id("boxes-file").set_input_files(tmp_path / "boxes.json")
    until(start, lambda: waiting)
    start.get_by_test_id("dialog-import").click()
    expect(dialog).to_contain_text("The file was still being read")
    # another recording, chosen before the answer
    start.get_by_test_id("boxes-recording").select_option(label=first.name)
    waiting[0].continue_()
    expect(found).to_contain_text("on 2 images")
    expect(dialog).not_to_contain_text("could be of several recordings")
    expect(dialog).to_contain_text("replaces the boxes drawn on 1 image.")
    # a look that fails leaves nothing to import
    refuse(start, f"boxes-files/*?recording={first.id}")
    start.get_by_test_id("boxes-recording").select_option(label="any recording")
    expect(dialog).to_contain_text("could be of several recordings")
    start.get_by_test_id("boxes-recording").select_option(label=first.name)
    expect(found).to_have_count(0)
    expect(start.get_by_test_id("boxes-about").get_by_role("alert")).not_to_be_empty()
    start.get_by_test_id("dialog-import").click()
    expect(dialog).to_contain_text("Choose a file with boxes first")
    assert project.boxes.on_images() == before


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
        expect(start.get_by_test_id("boxes-become")).to_be_hidden()
        start.get_by_test_id("boxes-file").set_input_files(tmp_path / f"{source}.json")
        expect(start.get_by_test_id("boxes-found")).to_contain_text(f"{len(boxes)} 3D boxes in 2 frames")
        expect(start.get_by_test_id("boxes-class-Person")).to_have_value("person")
        if project.labels.select():
            says = "1 of these frames has labels or proposals, and can only take proposals."
            expect(dialog).to_contain_text(says)
        expect(start.get_by_test_id("boxes-kind")).to_be_hidden()
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
    start.goto(f"/#/{name}/review")
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
    expect(start.get_by_title("Score: ")).to_have_attribute("title", "Score: of mine")
    # undone as one step
    start.keyboard.press("Control+z")
    expect(items).to_have_count(0)
    sources.select_option("")
    expect(start.get_by_test_id("queue-said")).to_have_text(["mine", "mine"])
