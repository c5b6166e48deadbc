"""Attributes in Review: fields, one key each, the filter of the queue, and undo."""

from __future__ import annotations

import pytest
from review_desk import Desk

from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, ClassStyle
from annotator.types import ReviewState

expect = pytest.importorskip("playwright.sync_api", reason="playwright is not installed").expect

SCHEMA = [
    {"name": "pose", "kind": "choice", "choices": ["sitting", "standing"], "key": "o", "required": True},
    {"name": "note", "kind": "text", "key": "t"},
    {"name": "mass", "kind": "number", "maximum": 100, "key": "m"},
    {"name": "rain", "kind": "boolean", "of": "frame", "key": "r", "default": False},
]


def with_attributes(desk: Desk) -> None:
    """Gives the project attributes, and opens it anew."""
    for fields in SCHEMA:
        desk.project.change_classes(
            lambda config, fields=fields: edit.put_attribute(config, Attribute.model_validate(fields)), "Ada"
        )
    desk.project.change_classes(lambda config: edit.add_class(config, "chair", ClassStyle(key="c")), "Ada")
    desk.page.reload()
    desk.settled()


def values_of(desk: Desk, uid: str) -> dict[str, object]:
    return dict(desk.project.labels.get(uid).label.attributes)


def test_fields_and_keys_set_values_and_the_queue_filters_by_them(desk: Desk, wait_for) -> None:
    with_attributes(desk)
    page, project = desk.page, desk.project
    uid = desk.uid
    expect(page.get_by_test_id("attributes")).to_be_visible()

    def values() -> dict[str, object]:
        return values_of(desk, uid)

    desk.press("Alt+o")
    wait_for(lambda: values() == {"pose": "sitting"})
    expect(page.get_by_test_id("attribute-pose").locator("option:checked")).to_have_text("sitting")
    expect(page.get_by_test_id("label-facts")).to_contain_text("until it is reviewed")
    desk.settled()
    desk.press("Alt+o")
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
    # the values are at the box, and in its row
    expect(page.get_by_test_id("review-image").get_by_text("pose=sitting, mass=81.5")).to_be_visible()
    expect(page.locator(f'[data-testid="frame-box"][data-uid="{uid}"]')).to_have_attribute(
        "title", "pose=sitting, mass=81.5"
    )
    page.get_by_test_id("queue-attribute").select_option("mass~")
    expect(page.get_by_test_id("queue-low")).to_be_focused()
    page.keyboard.type("82")
    page.keyboard.press("Enter")
    expect(page.get_by_test_id("queue-remaining")).to_have_text("0 proposals")
    page.get_by_test_id("queue-low").fill("81")
    page.keyboard.press("Enter")
    expect(page.get_by_test_id("queue-remaining")).to_have_text("1 proposal")
    page.get_by_test_id("queue-attribute").select_option("rain=true")
    expect(page.get_by_test_id("queue-remaining")).to_have_text("0 proposals")
    expect(page.get_by_test_id("queue-low")).to_be_hidden()
    page.get_by_test_id("queue-attribute").select_option("pose=")
    expect(page.get_by_test_id("queue-remaining")).not_to_have_text("0 proposals")
    expect(page.get_by_test_id("queue-remaining")).not_to_have_text("1 proposal")
    wait_for(lambda: desk.uid != uid)
    desk.settled()
    other = desk.uid
    desk.press("Alt+c")
    wait_for(lambda: project.labels.get(other).label.label == "chair")


def test_what_is_typed_is_stored_on_its_box_however_it_is_left(desk: Desk, wait_for) -> None:
    with_attributes(desk)
    page, project, selected = desk.page, desk.project, '[data-testid="frame-box"][aria-current="true"]'
    mass, note = page.get_by_test_id("attribute-mass"), page.get_by_test_id("attribute-note")

    def left(uid: str) -> None:
        page.locator(f'{selected}:not([data-uid="{uid}"])').wait_for()
        desk.settled()
        for field in (mass, note, page.get_by_test_id("field-track")):
            expect(field).to_have_value("")
        assert not values_of(desk, desk.uid)

    # a text, and a click on another box, here and in another frame
    here = page.locator('[data-testid="frame-box"]:not([aria-current="true"])').first
    there = next(one for one in project.labels.select() if one.frame_id != desk.frame).label.uid
    for other in (here, page.locator(f'[data-testid="queue-item"][data-uid="{there}"]')):
        uid = desk.uid
        note.focus()
        page.keyboard.type("seen")
        other.click()
        left(uid)
        wait_for(lambda uid=uid: values_of(desk, uid) == {"note": "seen"})
    # a number, and a key that decides or leaves the frame
    for field, key, state in (
        ("attribute-mass", "Space", ReviewState.ACCEPTED),
        ("attribute-mass", "x", ReviewState.REJECTED),
        ("field-track", "x", ReviewState.REJECTED),
    ):
        uid = desk.uid
        page.get_by_test_id(field).focus()
        page.keyboard.type("81")
        desk.press(key)
        left(uid)
        stored = project.labels.get(uid).label
        assert (stored.attributes.get("mass"), stored.track_id) == ((81.0, None) if "mass" in field else (None, 81))
        assert stored.state is state
    expect(page.locator("#toasts .toast-error")).to_have_count(0)

    # a field shows the stored value again after a refusal
    for typed, shown in (("99", "99"), ("1e", "99"), ("102", "99")):
        mass.focus()
        desk.press("Control+a")
        page.keyboard.type(typed)
        desk.press("Enter")
        desk.settled()
        expect(mass).to_have_value(shown)
    expect(page.get_by_test_id("toast-error")).to_contain_text("mass")
