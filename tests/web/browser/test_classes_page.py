"""The dialog of classes and attributes, and what open pages show after a change of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from browser_page import FRAME, Bench, Desk, middle

from annotator.project import Project
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, ClassStyle

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

expect = pytest.importorskip("playwright.sync_api").expect


def row(page: Page, name: str) -> Locator:
    return page.locator(f'[data-testid="class-row"][data-name="{name}"]')


def test_classes_are_changed_in_a_dialog_of_the_start_page(room: Project, start: Page) -> None:
    page, name = start, room.path.name
    page.get_by_test_id(f"edit-classes-{name}").click()
    page.get_by_test_id("new-class").fill("dog")
    page.keyboard.press("Enter")
    # what is typed is stored by the press of a button, and the click counts although the rows are drawn again
    row(page, "dog").get_by_label("Key of dog").fill("e")
    page.mouse.move(*middle(row(page, "dog").get_by_role("button", name="Rename")))
    with page.expect_response(lambda answer: answer.request.method == "GET" and answer.url.endswith("/classes")):
        page.mouse.down()
    page.wait_for_timeout(100)
    page.mouse.up()
    expect(page.get_by_test_id("ask-name")).to_have_value("dog")
    page.get_by_test_id("dialog-cancel").click()
    expect(row(page, "dog").get_by_label("Key of dog")).to_have_value("e")
    row(page, "dog").get_by_label("Key of dog").fill("d")
    page.keyboard.press("Enter")
    row(page, "dog").get_by_label("Colour of dog").fill("#3366ff")
    expect(row(page, "dog").get_by_role("button", name="Default colour for dog")).to_be_visible()
    row(page, "dog").get_by_role("button", name="Move dog up").click()
    expect(page.get_by_test_id("class-row").first).to_have_attribute("data-name", "dog")
    assert room.config.class_styles == {"dog": ClassStyle(colour="#3366ff", key="d")}

    row(page, "person").get_by_label("Key of person").fill("d")
    page.keyboard.press("Enter")
    expect(page.get_by_test_id("classes-problem")).to_contain_text("two classes or attributes have the key 'd'")
    row(page, "person").get_by_role("button", name="Rename").click()
    page.get_by_test_id("ask-name").fill("human")
    page.get_by_test_id("dialog-apply").click()
    row(page, "human").get_by_role("button", name="Remove").click()
    expect(page.get_by_role("dialog", name="Remove human")).to_contain_text("No box is of this class")
    page.get_by_test_id("dialog-cancel").click()
    row(page, "human").get_by_role("button", name="Merge").click()
    expect(page.get_by_test_id("ask-classes")).to_contain_text("Undo (Ctrl+Z) takes it back")
    page.get_by_test_id("dialog-apply").click()
    expect(page.get_by_test_id("class-row")).to_have_count(1)
    assert room.config.classes == ("dog",)

    # what was typed is added by Done, too, unless it is refused
    page.get_by_test_id("new-class").fill("a/b")
    page.get_by_test_id("dialog-done").click()
    expect(page.get_by_test_id("classes-dialog").get_by_role("alert")).to_contain_text("a/b")
    page.get_by_test_id("new-class").fill("cat")
    page.get_by_test_id("dialog-done").click()
    expect(page.get_by_test_id(f"project-{name}").locator(".chip")).to_have_text(["dog", "cat"])
    assert room.config.classes == ("dog", "cat")


def test_attributes_are_defined_in_label_and_set_there_with_one_key(bench: Bench, wait_for) -> None:
    page, project = bench.page, bench.project
    page.get_by_test_id("edit-classes").click()

    def define(name: str, kind: str, key: str, of: str = "box", choices: str = "") -> None:
        page.get_by_test_id("add-attribute").click()
        form = page.get_by_test_id("attribute-dialog")
        form.get_by_test_id("attribute-name").fill(name)
        form.get_by_test_id("attribute-kind").select_option(kind)
        form.get_by_test_id("attribute-of").select_option(of)
        if choices:
            form.get_by_test_id("attribute-choices").fill(choices)
        form.get_by_test_id("attribute-key").fill(key)
        form.get_by_test_id("dialog-save").click()
        expect(page.locator(f'[data-testid="attribute-row"][data-name="{name}"]')).to_be_visible()

    define("pose", "choice", "o", choices="sitting\nstanding")
    define("rain", "boolean", "r", of="frame")
    define("mass", "number", "m")
    page.get_by_test_id("classes-dialog").get_by_test_id("dialog-done").click()
    assert [each.name for each in project.config.attributes] == ["pose", "rain", "mass"]

    fields = page.get_by_test_id("attributes")
    expect(fields.locator("select, input")).to_have_count(1)
    page.keyboard.press("Alt+r")
    wait_for(lambda: project.frames.attributes() == {FRAME: {"rain": True}})
    bench.draw_object(0)
    expect(fields.locator("select, input")).to_have_count(3)
    page.keyboard.press("Alt+o")
    wait_for(lambda: dict(bench.labels[0].attributes) == {"pose": "sitting"})
    page.keyboard.press("Alt+m")
    page.keyboard.type("70")
    page.keyboard.press("Enter")
    wait_for(lambda: dict(bench.labels[0].attributes) == {"pose": "sitting", "mass": 70.0})
    bench.saved()
    page.keyboard.press("Tab")
    page.keyboard.press("Control+z")
    wait_for(lambda: dict(bench.labels[0].attributes) == {"pose": "sitting"})

    # a value that is in the way of a narrower definition is removed only if that is wanted
    page.get_by_test_id("edit-classes").click()
    page.locator('[data-testid="attribute-row"][data-name="pose"]').get_by_role("button", name="Edit").click()
    form = page.get_by_test_id("attribute-dialog")
    form.get_by_test_id("attribute-choices").fill("lying")
    form.get_by_test_id("dialog-save").click()
    expect(form.get_by_role("alert")).to_contain_text("1 stored value of pose would not fit")
    form.get_by_test_id("attribute-drop").check()
    form.get_by_test_id("dialog-save").click()
    expect(form).to_have_count(0)
    assert dict(bench.labels[0].attributes) == {}
    page.get_by_test_id("classes-dialog").get_by_test_id("dialog-done").click()
    page.keyboard.press("Control+z")
    expect(page.get_by_text("Undone: change the attribute pose")).to_be_visible()
    wait_for(lambda: dict(bench.labels[0].attributes) == {"pose": "sitting"})
    expect(page.get_by_test_id("attribute-pose").locator("option:checked")).to_have_text("sitting")


def test_open_pages_show_changed_classes_and_keep_unsaved_work(desk: Desk, wait_for) -> None:
    page, project, uid = desk.page, desk.project, desk.uid
    # typed, but not saved yet
    page.get_by_test_id("field-yaw").fill("12")
    expect(page.get_by_test_id("label-state")).to_have_text("not saved")
    project.change_classes(edit.RenameClass(name="person", new="human"), "Cleo")
    pose = Attribute.model_validate({"name": "pose", "kind": "choice", "choices": ["sitting", "standing"], "key": "o"})
    project.change_classes(edit.PutAttribute(attribute=pose), "Cleo")
    expect(page.get_by_test_id("field-class").locator("option")).to_have_text(["human"])
    expect(page.get_by_test_id("queue-attribute")).to_be_visible()
    expect(page.get_by_test_id("queue-item").first).to_contain_text("human")
    expect(page.get_by_test_id("label-state")).to_have_text("not saved")
    page.keyboard.press("Enter")
    wait_for(lambda: desk.label.state == "edited")
    assert (desk.uid, desk.label.label) == (uid, "human")
    desk.settled()
    # without a box, only attributes of the frame are shown
    page.get_by_test_id("field-yaw").blur()
    desk.press("Escape")
    expect(page.get_by_test_id("attribute-pose")).to_have_count(0)
