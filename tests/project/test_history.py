"""Undo and redo: per operator, over all frames and recordings, from the log; changes of others are never lost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from store_samples import box_at, by_hand, by_machine, proposal_at, revised

from annotator.project import FramePart, NewLabel, Project, StoredRecording
from annotator.project.backup.verify import verify
from annotator.project.changes import LabelDeleted
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, AttributeOf
from annotator.project.log import new_action
from annotator.types import ReviewState
from annotator.types.errors import HistoryError


def test_the_next_undo_and_redo_are_described(project: Project, frame: int) -> None:
    assert project.history.next("ann") == (None, None)
    uids = project.proposals.replace(frame, [proposal_at(0.0), proposal_at(5.0)], by_machine()).uids
    assert project.history.next("ann") == (None, None), "an automatic pass cannot be undone"
    project.labels.accept(frame, uids[0], by_hand(1))
    assert project.history.next("ann") == ("accept hand (frame 3)", None)
    project.log.append(frame, [LabelDeleted(uid=uid) for uid in uids], by_hand(2))
    assert project.history.next("ann") == ("delete 2 labels (frame 3)", None)
    done = project.history.undo("ann")
    assert (done.words, done.frame_id, project.frames.get(frame).revision) == ("delete 2 labels (frame 3)", frame, 5)
    assert project.history.next("ann") == ("accept hand (frame 3)", "delete 2 labels (frame 3)")
    project.frames.finalise(frame, by_hand(5))
    assert project.history.next("ann") == ("finalise frame 3", None), "a new action empties the redo stack"


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
    first, second = "draw hand (frame 3)", "draw 2 labels (frame 3)"
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


def test_an_undo_that_conflicts_with_a_later_change_names_it_and_can_be_skipped(project: Project, frame: int) -> None:
    uids = project.proposals.replace(frame, [proposal_at(0.0), proposal_at(5.0)], by_machine()).uids
    project.labels.accept(frame, uids[1], by_hand(1))
    project.labels.accept(frame, uids[0], by_hand(2))
    project.labels.edit(frame, uids[0], by_hand(3, "bob"), label="person", box=box_at(1.0))
    with pytest.raises(HistoryError, match=r"the hand label was changed by bob since .*nothing was changed") as caught:
        project.history.undo("ann")
    assert caught.value.frame_id == frame
    assert project.history.undo("ann", skip=True).words == "accept hand (frame 3)"
    states = [label.state for label in project.labels.of_frame(frame)]
    assert states == [ReviewState.EDITED, ReviewState.PROPOSED]


# An attribute as it was, a value that it had, and the attribute as it is now.
BEFORE, VALUE, AFTER = {"kind": "boolean"}, True, {"kind": "integer"}


def put(project: Project, of: str, definition: dict[str, Any], name: str = "state", *, drop: bool = False) -> None:
    attribute = Attribute(name=name, of=AttributeOf(of), **definition)
    project.change_classes(edit.PutAttribute(attribute=attribute, drop=drop), "bea")


def set_on_frame(project: Project, frame: int, **values: Any) -> None:
    project.frames.set_attributes(frame, values, revised(project, frame))


@pytest.mark.parametrize("of", ["box", "frame"])
def test_undo_leaves_out_values_that_no_longer_fit_and_says_so(project: Project, frame: int, of: str) -> None:
    put(project, of, BEFORE)
    put(project, of, {"kind": "text"}, "note")
    (uid,) = project.labels.create(frame, [NewLabel("hand", box_at())], by_hand()).uids

    def give(**values: Any) -> None:
        if of == "frame":
            set_on_frame(project, frame, **values)
        else:
            project.labels.set_attributes(frame, uid, values, revised(project, frame))

    def given() -> Any:
        return project.frames.attributes_of(frame) if of == "frame" else project.labels.get(uid).label.attributes

    give(state=VALUE, note="one")
    give(state=None, note="two")
    put(project, of, AFTER)
    words = f"set attributes of {'the frame' if of == 'frame' else 'hand'} (frame 3)"
    left_out = "; without values that the project no longer allows: state"
    assert (project.history.undo("ann").words, given()) == (words + left_out, {"note": "one"})
    give(note="three")
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


KEYS = ["0", "1"]
BOTH = ["left-both", "right-both"]


@pytest.fixture
def rooms(project: Project) -> list[StoredRecording]:
    """Three recordings: left, right and third."""
    names = ("left", "right", "third")
    return [project.recordings.add(project.path / name, "rgbd", name, KEYS, True) for name in names]


def draw(project: Project, what: str, recordings: Sequence[StoredRecording], action: str | None = None) -> None:
    """Draws a box in the first frame of each recording, as one action."""
    parts = []
    for each in recordings:
        frame = project.frames.of([each.id])[0]
        drawn = NewLabel("hand", box_at(frame.revision), uid=f"{each.name}-{what}")
        parts.append(FramePart(frame.id, [drawn], by_hand(frame.revision)))
    project.log.append_to_frames(parts, action)


def remove(project: Project, recording: StoredRecording) -> None:
    project.recordings.remove(recording.id, "bea")


def bring_back(project: Project, recording: StoredRecording) -> None:
    project.recordings.rescan(recording.id, KEYS)


def changed_by_bob(project: Project, recording: StoredRecording, what: str) -> None:
    frame = project.frames.of([recording.id])[0]
    change = by_hand(frame.revision, "bob")
    project.labels.edit(frame.id, f"{recording.name}-{what}", change, label="person", box=box_at(9.0))


def uids(project: Project) -> list[str]:
    """Of all labels; checks that what is kept is what the log gives."""
    assert verify(project.path, deep=True).problems == ()
    return sorted(label.label.uid for label in project.labels.select())


@pytest.mark.parametrize("is_first", [True, False])
def test_an_action_is_reverted_as_a_whole_also_where_a_recording_is_removed(
    project: Project, rooms: list[StoredRecording], is_first: bool
) -> None:
    away, there = rooms[:2] if is_first else rooms[1::-1]
    draw(project, "both", rooms[:2])
    remove(project, away)
    done = project.history.undo("ann")
    assert (done.frame_id, uids(project)) == (project.frames.of([there.id])[0].id, [])
    bring_back(project, away)
    assert uids(project) == []
    remove(project, away)
    project.history.redo("ann")
    assert (uids(project), project.history.next("ann")[1]) == ([f"{there.name}-both"], None)
    bring_back(project, away)
    assert uids(project) == BOTH


def test_an_action_is_hidden_while_all_its_recordings_are_removed(
    project: Project, rooms: list[StoredRecording]
) -> None:
    left, right, third = rooms
    draw(project, "below", [third])
    draw(project, "both", [left, right])
    remove(project, left)
    remove(project, right)
    project.history.undo("ann")
    assert (uids(project), project.history.next("ann")[0]) == ([], None)
    bring_back(project, right)
    bring_back(project, left)
    assert project.history.next("ann") == ("draw 2 labels (frames 1 to 1)", "draw hand (frame 1)")
    assert (project.history.undo("ann").words, uids(project)) == ("draw 2 labels (frames 1 to 1)", [])
    for expected in (BOTH, [*BOTH, "third-below"]):
        project.history.redo("ann")
        assert uids(project) == expected


def test_a_step_that_others_have_changed_is_asked_about_again_only_in_other_recordings(
    project: Project, rooms: list[StoredRecording]
) -> None:
    left, right, _ = rooms
    for recording in (left, right):
        draw(project, "one", [recording])
        draw(project, "two", [recording])
        changed_by_bob(project, recording, "two")
    project.history.undo("ann", skip=True)
    assert uids(project) == ["left-one", "left-two", "right-two"]
    with pytest.raises(HistoryError, match="was changed by bob"):
        project.history.undo("ann")
    project.history.undo("ann", skip=True)
    assert (uids(project), project.history.next("ann")[0]) == (["left-two", "right-two"], None)


def test_an_action_that_is_written_in_several_calls_keeps_its_place_and_ends_when_it_is_undone(
    project: Project, rooms: list[StoredRecording]
) -> None:
    left, right, third = rooms
    action = new_action()
    draw(project, "both", [left], action)
    project.labels.create(project.frames.of([left.id])[1].id, [NewLabel("hand", box_at())], by_hand())
    assert project.history.undo("ann").words == "draw hand (frame 2)"
    draw(project, "both", [right], action)
    assert project.history.next("ann") == ("draw 2 labels (frames 1 to 1)", "draw hand (frame 2)")
    assert (project.history.undo("ann").words, uids(project)) == ("draw 2 labels (frames 1 to 1)", [])
    with pytest.raises(HistoryError, match="it was undone while it was running"):
        draw(project, "both", [third], action)
    project.history.redo("ann")
    assert uids(project) == BOTH
