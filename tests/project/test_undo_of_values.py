"""Undo and redo of values of attributes that the project's schema no longer allows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest
from store_samples import box_at, by_hand

from annotator.project import NewLabel, Project
from annotator.project.backup.verify import verify
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, AttributeOf
from annotator.project.log.writing import new_action
from annotator.types.errors import ProjectError

# An attribute as it was, a value that it had, and the attribute as it is now.
BEFORE, VALUE, AFTER = {"kind": "boolean"}, True, {"kind": "integer"}


def put(project: Project, of: str, definition: dict[str, Any], *, drop: bool = False) -> None:
    attribute = Attribute(name="state", of=AttributeOf(of), **definition)
    project.change_classes(lambda config: edit.put_attribute(config, attribute, drop=drop), "ann")


def put_note(project: Project, of: str) -> None:
    note = Attribute(name="note", kind="text", of=AttributeOf(of))
    project.change_classes(lambda config: edit.put_attribute(config, note), "ann")


def revised(project: Project, frame: int) -> Any:
    return by_hand(project.frames.get(frame).revision)


def set_on_frame(project: Project, frame: int, **values: Any) -> None:
    project.frames.set_attributes(frame, values, revised(project, frame))


def set_on_label(project: Project, frame: int, uid: str, **values: Any) -> None:
    project.labels.set_attributes(frame, uid, values, revised(project, frame))


def create(project: Project, frame: int) -> str:
    return project.labels.create(frame, [NewLabel("hand", box_at())], revised(project, frame)).uids[0]


def undone_and_redone(project: Project, seen: Callable[[], Any]) -> Sequence[Any]:
    """What is seen after each undo; redo gives the same in the opposite order."""
    states, count = [seen()], 0
    while project.history.next("ann")[0] is not None:
        project.history.undo("ann")
        states.append(seen())
        count += 1
    for state in reversed(states[:-1]):
        project.history.redo("ann")
        assert seen() == state
    assert verify(project.path, deep=True).problems == ()
    return states


def test_undo_leaves_out_values_of_a_label_that_no_longer_fit(project: Project, frame: int) -> None:
    put(project, "box", BEFORE)
    put_note(project, "box")
    uid = create(project, frame)
    set_on_label(project, frame, uid, state=VALUE, note="one")
    set_on_label(project, frame, uid, state=None, note="two")
    put(project, "box", AFTER)
    words = "set attributes of hand (frame 2); without values that the project no longer allows: state"
    assert project.history.undo("ann").words == words
    assert project.labels.get(uid).label.attributes == {"note": "one"}
    set_on_label(project, frame, uid, note="three")
    project.history.undo("ann")

    def seen() -> Any:
        return [label.label.attributes for label in project.labels.select()]

    assert undone_and_redone(project, seen) == [[{"note": "one"}], [{}], []]


def test_undo_leaves_out_values_of_a_frame_that_no_longer_fit(project: Project, frame: int) -> None:
    put(project, "frame", BEFORE)
    put_note(project, "frame")
    set_on_frame(project, frame, state=VALUE, note="one")
    set_on_frame(project, frame, state=None, note="two")
    put(project, "frame", AFTER)
    words = "set attributes of the frame (frame 2); without values that the project no longer allows: state"
    assert project.history.undo("ann").words == words
    assert project.frames.attributes_of(frame) == {"note": "one"}
    set_on_frame(project, frame, note="three")
    assert project.frames.attributes_of(frame) == {"note": "three"}
    project.history.undo("ann")
    assert undone_and_redone(project, lambda: project.frames.attributes_of(frame)) == [{"note": "one"}, {}]


def test_undo_leaves_out_values_of_imported_proposals_that_no_longer_fit(project: Project, frame: int) -> None:
    put(project, "box", BEFORE)
    put_note(project, "box")
    boxes = [NewLabel("hand", box_at(), 0.5, attributes={"state": VALUE, "note": "one"})]
    project.proposals.bring("mine", {frame: boxes}, "ann", new_action())
    project.proposals.bring("mine", {frame: []}, "ann", new_action())
    put(project, "box", AFTER)
    words = "import boxes of mine (frame 2); without values that the project no longer allows: state"
    assert project.history.undo("ann").words == words
    (shown,) = project.labels.select()
    assert shown.label.attributes == {"note": "one"}
    project.labels.accept(frame, shown.label.uid, revised(project, frame))
    set_on_label(project, frame, shown.label.uid, note="two")
    assert verify(project.path, deep=True).problems == ()


def test_undo_leaves_out_values_of_another_source_that_it_shows_again(project: Project, frame: int) -> None:
    put(project, "box", BEFORE)
    project.proposals.bring("mine", {frame: [NewLabel("hand", box_at(), 0.2, attributes={"state": VALUE})]})
    project.proposals.bring("better", {frame: [NewLabel("hand", box_at(), 0.9)]}, "ann", new_action())
    assert [each.label.attributes for each in project.labels.select()] == [{"state": VALUE}]
    put(project, "box", AFTER, drop=True)
    project.history.undo("ann")
    (shown,) = project.labels.select()
    assert [each.source for each in project.labels.get(shown.label.uid).said] == ["mine"]
    assert shown.label.attributes == {}
    assert verify(project.path, deep=True).problems == ()


def test_undo_leaves_out_values_of_an_attribute_that_was_removed_and_added_anew(project: Project, frame: int) -> None:
    put(project, "box", BEFORE)
    uid = create(project, frame)
    set_on_label(project, frame, uid, state=VALUE)
    project.change_classes(lambda config: edit.remove_attribute(config, "state"), "ann")
    put(project, "frame", AFTER)
    put_note(project, "frame")

    def seen() -> Any:
        return [label.label.attributes for label in project.labels.select()], project.frames.attributes_of(frame)

    set_on_frame(project, frame, note="one")
    assert undone_and_redone(project, seen) == [([{}], {"note": "one"}), ([{}], {}), ([{}], {}), ([], {})]
    set_on_frame(project, frame, note="two")
    # and once more, the other way round
    project.change_classes(lambda config: edit.remove_attribute(config, "state"), "ann")
    put(project, "box", BEFORE)
    project.history.undo("ann")
    project.history.undo("ann")
    project.history.undo("ann")
    assert seen() == ([{}], {})
    set_on_label(project, frame, uid, state=VALUE)
    assert seen() == ([{"state": VALUE}], {})
    assert verify(project.path, deep=True).problems == ()


def test_an_old_value_of_a_frame_blocks_no_save_of_others(project: Project, frame: int) -> None:
    put(project, "frame", {"kind": "boolean"})
    put_note(project, "frame")
    set_on_frame(project, frame, state=True)
    # somebody has changed the file by hand
    path = project.path / "project.json"
    path.write_text(path.read_text().replace('"boolean"', '"integer"'))
    set_on_frame(project, frame, note="one")
    assert project.frames.attributes_of(frame) == {"state": True, "note": "one"}
    with pytest.raises(ProjectError, match="state must be a whole number, not false"):
        set_on_frame(project, frame, state=False)
    # true is not the same as 1
    set_on_frame(project, frame, state=1)
    assert type(project.frames.attributes_of(frame)["state"]) is int
