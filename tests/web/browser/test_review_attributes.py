"""Attributes in Review: fields, one key each, the filter of the queue, and undo."""

from __future__ import annotations

import pytest
from review_desk import Desk

from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, ClassStyle

expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect

SCHEMA = [
    {"name": "pose", "kind": "choice", "choices": ["sitting", "standing"], "key": "o", "required": True},
    {"name": "mass", "kind": "number", "key": "m"},
    {"name": "rain", "kind": "boolean", "of": "frame", "key": "r", "default": False},
]


def test_fields_and_keys_set_values_and_the_queue_filters_by_them(desk: Desk, wait_for) -> None:
    page, project = desk.page, desk.project
    for fields in SCHEMA:
        project.change_classes(
            lambda config, fields=fields: edit.put_attribute(config, Attribute.model_validate(fields)), "Ada"
        )
    project.change_classes(lambda config: edit.add_class(config, "chair", ClassStyle(key="c")), "Ada")
    page.reload()
    desk.settled()
    uid = desk.uid
    expect(page.get_by_test_id("attributes")).to_be_visible()

    def values() -> dict[str, object]:
        return dict(project.labels.get(uid).label.attributes)

    desk.press("Alt+o")
    wait_for(lambda: values() == {"pose": "sitting"})
    expect(page.get_by_test_id("attribute-pose").locator("option:checked")).to_have_text("sitting")
    expect(page.get_by_test_id("label-facts")).to_contain_text("until it is reviewed")
    desk.settled()
    # as on a Mac
    page.evaluate("dispatchEvent(new KeyboardEvent('keydown', { key: 'ø', code: 'KeyO', altKey: true }))")
    wait_for(lambda: values() == {"pose": "standing"})
    desk.settled()
    page.get_by_test_id("attribute-pose").select_option(label="sitting")
    wait_for(lambda: values() == {"pose": "sitting"})
    desk.settled()
    desk.press("Alt+m")
    expect(page.get_by_test_id("attribute-mass")).to_be_focused()
    page.keyboard.type("81.5")
    desk.press("Tab")
    wait_for(lambda: values() == {"pose": "sitting", "mass": 81.5})
    desk.settled()
    desk.press("Alt+r")
    wait_for(lambda: project.frames.attributes().get(desk.frame) == {"rain": True})
    desk.settled()
    desk.press("Control+z")
    wait_for(lambda: project.frames.attributes() == {})
    desk.settled()

    page.get_by_test_id("queue-attribute").select_option("pose=sitting")
    expect(page.get_by_test_id("queue-item")).to_have_count(1)
    assert desk.uid == uid
    page.get_by_test_id("queue-attribute").select_option("pose=")
    expect(page.get_by_test_id("queue-remaining")).not_to_have_text("1 proposal")
    wait_for(lambda: desk.uid != uid)
    desk.settled()
    other = desk.uid
    desk.press("Alt+c")
    wait_for(lambda: project.labels.get(other).label.label == "chair")
