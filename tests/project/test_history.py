"""Undo and redo: per operator, over all frames, from the log. Changes of other operators are never lost."""

from __future__ import annotations

import contextlib
import tempfile
import uuid
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from store_samples import (
    Step,
    actions,
    box_at,
    by_hand,
    by_machine,
    content,
    give_attributes,
    lists_of_steps,
    proposal_at,
    repr_of,
    some_boxes,
    state_of,
)

from annotator.project import FramePart, NewLabel, Project, StoredRecording, create_project, open_project
from annotator.project.backup.verify import verify
from annotator.project.changes import FrameFinalised, LabelCreated, LabelDeleted, LabelTracked, Payload
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, AttributeOf
from annotator.project.log import new_action
from annotator.project.records import BoxRecord
from annotator.types import BoxKind, ReviewState
from annotator.types.errors import ConfigError, HistoryError, ProjectError

KINDS = ("undo", "redo", "adjust", "values", "frame values")
STEPS = lists_of_steps(*KINDS, frames=2, longest=14)


def _take(project: Project, view: str, step: Step) -> None:
    """Applies one action of ann; the project refuses actions that the current state does not allow."""
    more = {"undo": lambda: project.history.undo("ann"), "redo": lambda: project.history.redo("ann")}
    with contextlib.suppress(ProjectError, ConfigError):
        (actions(project, [view], step) | more)[step[0]]()


def _all(step: Callable[[], object]) -> int:
    count = 0
    while True:
        try:
            step()
        except HistoryError as error:
            assert "has nothing to" in str(error)
            return count
        count += 1


@settings(max_examples=8)
@given(STEPS, st.booleans())
def test_undoing_all_restores_the_first_state_and_redoing_all_the_last(steps: list[Step], restart: bool) -> None:
    with tempfile.TemporaryDirectory() as folder:
        project = create_project(Path(folder), "p", ("hand", "person"))
        project.recordings.add(Path(folder) / "r", "rgbd", "r", ["0", "1"], True)
        view = project.views.store(np.full((2, 2, 3), 7, np.uint8))
        give_attributes(project)
        for frame in project.frames.of():
            project.proposals.replace(frame.id, [proposal_at(0.0), proposal_at(5.0)], by_machine())
        before = content(project)
        for step in steps:
            if step[0] not in ("propose", "bring"):
                _take(project, view, step)
        _all(lambda: project.history.redo("ann"))
        after = content(project)
        events = list(project.log.since())
        if restart:
            project.close()
            project = open_project(project.path)
        with project:
            undone = _all(lambda: project.history.undo("ann"))
            assert content(project) == before
            assert _all(lambda: project.history.redo("ann")) == undone
            assert content(project) == after
            assert list(project.log.since())[: len(events)] == events, "the log only grows"
            maintained = state_of(project)
            project.log.rebuild()
            assert state_of(project) == maintained
            # the rebuild restores the undo states, too
            assert _all(lambda: project.history.undo("ann")) == undone
            assert content(project) == before


def test_only_labels_that_an_action_is_named_after_are_counted(project: Project, frame: int) -> None:
    uids = project.labels.create(frame, [NewLabel("hand", box_at(x)) for x in (0.0, 5.0)], by_hand()).uids
    project.log.append(frame, [LabelDeleted(uid=uids[0]), LabelTracked(uid=uids[1], track_id=1)], by_hand(2))
    assert project.history.undo("ann").words == "delete hand (frame 2)"


def test_the_next_undo_and_redo_are_described(project: Project, frame: int) -> None:
    assert project.history.next("ann") == (None, None)
    uids = project.proposals.replace(frame, [proposal_at(0.0), proposal_at(5.0)], by_machine()).uids
    assert project.history.next("ann") == (None, None), "an automatic pass cannot be undone"
    project.labels.accept(frame, uids[0], by_hand(1))
    assert project.history.next("ann") == ("accept hand (frame 2)", None)
    project.log.append(frame, [LabelDeleted(uid=uid) for uid in uids], by_hand(2))
    assert project.history.next("ann") == ("delete 2 labels (frame 2)", None)
    done = project.history.undo("ann")
    assert (done.words, done.frame_id, done.receipt.revision) == ("delete 2 labels (frame 2)", frame, 5)
    assert project.history.next("ann") == ("accept hand (frame 2)", "delete 2 labels (frame 2)")
    project.frames.finalise(frame, by_hand(5))
    assert project.history.next("ann") == ("finalise frame 2", None), "a new action empties the redo stack"


def test_a_page_that_is_read_while_its_operator_saves_elsewhere_sees_the_steps_of_its_own_moment(
    project: Project, frame: int
) -> None:
    def draw(count: int) -> None:
        new = [NewLabel("hand", box_at(float(n))) for n in range(count)]
        project.labels.create(frame, new, by_hand(project.frames.get(frame).revision))

    def elsewhere(act: Callable[[], object]) -> object:
        with ThreadPoolExecutor(1) as threads:  # a snapshot belongs to a thread
            return threads.submit(act).result()

    draw(1)
    first, second = "draw hand (frame 2)", "draw 2 labels (frame 2)"
    with project.store.snapshot():
        project.log.last()
        elsewhere(lambda: draw(2))
        assert elsewhere(lambda: project.history.next("ann")) == (second, None)
        assert project.history.next("ann") == (first, None)
        elsewhere(lambda: project.history.undo("ann"))
        assert elsewhere(lambda: project.history.next("ann")) == (first, second)
        assert project.history.next("ann") == (first, None)
    assert project.history.next("ann") == (first, second)
    assert project.history.redo("ann").words == second


def test_the_words_of_an_action_that_is_written_in_several_calls_are_those_of_the_moment(
    project: Project, recording: StoredRecording
) -> None:
    frames, action = project.frames.of(), new_action()

    def draw(frame: int) -> None:
        made = LabelCreated(uid=uuid.uuid4().hex, label="hand", box=BoxRecord.of(box_at()))
        project.log.append_to_frames([FramePart(frame, [made], by_hand())], action)

    draw(frames[0].id)
    with project.store.snapshot():
        project.log.last()
        with ThreadPoolExecutor(1) as threads:
            threads.submit(draw, frames[1].id).result()
            both = threads.submit(project.history.next, "ann").result()
        assert project.history.next("ann") == (f"draw hand (frame {frames[0].key})", None)
    # what the older moment said is not kept
    assert project.history.next("ann") == both == (f"draw 2 labels (frames {frames[0].key} to {frames[1].key})", None)


def test_operators_undo_only_their_own_actions(project: Project, recording: StoredRecording) -> None:
    one, two = (frame.id for frame in project.frames.of()[:2])
    project.boxes.set_on_image(one, some_boxes(1), BoxKind.BOX, by_hand(0, "ann"))
    project.boxes.set_on_image(two, some_boxes(2), BoxKind.BOX, by_hand(0, "bob"))
    project.history.undo("ann")
    assert project.boxes.on_image(one) is None
    assert project.boxes.on_image(two) is not None
    with pytest.raises(HistoryError, match="ann has nothing to undo"):
        project.history.undo("ann")


def test_an_undo_that_conflicts_with_a_later_change_is_refused_and_can_be_skipped(project: Project, frame: int) -> None:
    uids = project.proposals.replace(frame, [proposal_at(0.0), proposal_at(5.0)], by_machine()).uids
    project.labels.accept(frame, uids[1], by_hand(1, "ann"))
    project.labels.accept(frame, uids[0], by_hand(2, "ann"))
    project.labels.edit(frame, uids[0], by_hand(3, "bob"), label="person", box=box_at(1.0))
    before = content(project)
    with pytest.raises(HistoryError, match=r"the hand label was changed by bob since .*nothing was changed") as caught:
        project.history.undo("ann")
    assert caught.value.frame_id == frame
    assert content(project) == before
    done = project.history.undo("ann", skip=True)
    assert done.words == "accept hand (frame 2)"
    states = {label.uid: label.state for label in project.labels.of_frame(frame)}
    assert states == {uids[0]: ReviewState.EDITED, uids[1]: ReviewState.PROPOSED}
    # bob's undo removes the conflict
    project.history.undo("bob")
    assert project.labels.get(uids[0]).label.state is ReviewState.ACCEPTED
    project.history.redo("ann")
    assert project.labels.get(uids[1]).label.state is ReviewState.ACCEPTED


def test_what_followed_an_import_is_redone_after_the_import(project: Project, frame: int) -> None:
    project.proposals.bring("mine", {frame: [NewLabel("hand", box_at(), 0.5)]}, "ann", new_action())
    (label,) = project.labels.of_frame(frame)
    project.labels.accept(frame, label.uid, by_hand(project.frames.get(frame).revision))
    before = content(project)
    for step in (project.history.undo, project.history.undo, project.history.redo, project.history.redo):
        step("ann")
    assert content(project) == before


def test_a_redo_that_conflicts_with_new_proposals_names_their_author(project: Project, frame: int) -> None:
    uid = project.proposals.replace(frame, [proposal_at(0.0)], by_machine()).uids[0]
    project.labels.accept(frame, uid, by_hand(1))
    project.history.undo("ann")
    project.proposals.replace(frame, [proposal_at(9.0)], by_machine(3))
    with pytest.raises(HistoryError, match="cannot be redone because the hand label was changed by rcv since"):
        project.history.redo("ann")


def test_a_restored_label_is_complete_and_at_its_former_position(project: Project, frame: int) -> None:
    uids = project.proposals.replace(frame, [proposal_at(3.0 * n) for n in range(3)], by_machine()).uids
    before = project.labels.select()
    project.labels.delete(frame, uids[1], by_hand(1))
    project.history.undo("ann")
    after = project.labels.select()
    assert [repr_of(a.label) for a in after] == [repr_of(b.label) for b in before]
    assert [(a.quality, a.run_id) for a in after] == [(b.quality, b.run_id) for b in before]


def test_an_action_without_effect_is_skipped(project: Project, frame: int) -> None:
    project.boxes.set_on_image(frame, some_boxes(1), BoxKind.BOX, by_hand(0))
    new = LabelCreated(uid="u", label="hand", box=BoxRecord.of(box_at()))
    both: list[Payload] = [new, LabelDeleted(uid="u")]
    project.log.append(frame, both, by_hand(1))
    project.history.undo("ann")
    assert project.boxes.on_image(frame) is None


def test_an_undo_that_needs_a_removed_class_is_refused(project: Project, frame: int) -> None:
    project.labels.create(frame, [NewLabel("person", box_at())], by_hand(0))
    uid = project.labels.of_frame(frame)[0].uid
    project.labels.delete(frame, uid, by_hand(1))
    project.configure(classes=["hand"])
    with pytest.raises(ProjectError, match="the class 'person' was removed"):
        project.history.undo("ann")
    project.log.append(frame, [FrameFinalised()], by_hand(2))
    project.history.undo("ann")


# --- undo and redo of values of attributes that the project's schema no longer allows ---------------------------------

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
