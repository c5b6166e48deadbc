"""Undo and redo of actions over several recordings, some of which are removed and come back."""

from __future__ import annotations

from pathlib import Path

import pytest
from store_samples import box_at, by_hand

from annotator.project import FramePart, NewLabel, Project, StoredRecording, open_project
from annotator.project.backup.verify import verify
from annotator.project.changes import LabelCreated
from annotator.project.log import new_action
from annotator.project.records import BoxRecord
from annotator.types.errors import HistoryError

KEYS = ["0", "1"]
BOTH = ["left-both", "right-both"]


@pytest.fixture
def left(project: Project, tmp_path: Path) -> StoredRecording:
    return project.recordings.add(tmp_path / "left", "rgbd", "left", KEYS, True)


@pytest.fixture
def right(project: Project, left: StoredRecording, tmp_path: Path) -> StoredRecording:
    return project.recordings.add(tmp_path / "right", "rgbd", "right", KEYS, True)


def part(project: Project, recording: StoredRecording, what: str) -> FramePart:
    """Draws a box in the first frame of a recording."""
    frame = project.frames.of([recording.id])[0]
    drawn = LabelCreated(uid=f"{recording.name}-{what}", label="hand", box=BoxRecord.of(box_at(frame.revision)))
    return FramePart(frame.id, [drawn], by_hand(frame.revision))


def draw(project: Project, what: str, *recordings: StoredRecording) -> None:
    project.log.append_to_frames([part(project, each, what) for each in recordings])


def remove(project: Project, recording: StoredRecording) -> None:
    project.recordings.remove(recording.id, "bea")


def bring_back(project: Project, recording: StoredRecording) -> None:
    project.recordings.rescan(recording.id, KEYS)


def uids(project: Project) -> list[str]:
    """Of all labels; checks that what is kept is what the log gives, for the stacks, too."""
    assert verify(project.path, deep=True).problems == ()
    with open_project(project.path) as again:
        assert again.history.next("ann") == project.history.next("ann")
    return sorted(label.label.uid for label in project.labels.select())


@pytest.mark.parametrize("is_first", [True, False])
def test_an_action_is_undone_where_its_recordings_are_there_and_later_in_the_others(
    project: Project, left: StoredRecording, right: StoredRecording, is_first: bool
) -> None:
    away = left if is_first else right
    draw(project, "both", left, right)
    remove(project, away)
    assert project.history.next("ann") == ("draw hand (frame 0)", None)
    assert project.history.undo("ann").others == ()
    assert uids(project) == []
    with pytest.raises(HistoryError, match="ann has nothing to undo"):
        project.history.undo("ann")
    bring_back(project, away)
    assert uids(project) == [f"{away.name}-both"]
    project.history.undo("ann")
    assert uids(project) == []
    # redone one after the other
    project.history.redo("ann")
    assert uids(project) == [f"{away.name}-both"]
    project.history.redo("ann")
    assert uids(project) == BOTH
    with pytest.raises(HistoryError, match="ann has nothing to redo"):
        project.history.redo("ann")
    project.history.undo("ann")
    assert uids(project) == [f"{away.name}-both"]
    project.history.undo("ann")
    assert (uids(project), project.history.next("ann")[0]) == ([], None)


def test_an_undone_action_is_redone_where_its_recordings_are_there_and_later_in_the_others(
    project: Project, left: StoredRecording, right: StoredRecording
) -> None:
    away, there = left, right
    draw(project, "both", left, right)
    project.history.undo("ann")
    remove(project, away)
    project.history.redo("ann")
    assert uids(project) == [f"{there.name}-both"]
    assert project.history.next("ann")[1] is None
    bring_back(project, away)
    project.history.redo("ann")
    assert uids(project) == BOTH
    project.history.undo("ann")
    project.history.undo("ann")
    assert (uids(project), project.history.next("ann")) == ([], (None, "draw hand (frame 0)"))


def test_an_action_is_hidden_while_all_its_recordings_are_removed(
    project: Project, left: StoredRecording, right: StoredRecording, tmp_path: Path
) -> None:
    third = project.recordings.add(tmp_path / "third", "rgbd", "third", KEYS, True)
    draw(project, "below", third)
    draw(project, "both", left, right)
    remove(project, left)
    remove(project, right)
    project.history.undo("ann")
    assert (uids(project), project.history.next("ann")[0]) == ([], None)
    bring_back(project, right)
    bring_back(project, left)
    assert project.history.next("ann") == ("draw 2 labels (frames 0 to 0)", "draw hand (frame 0)")
    assert len(project.history.undo("ann").others) == 1
    assert uids(project) == []
    project.history.redo("ann")
    assert uids(project) == BOTH
    project.history.redo("ann")
    assert uids(project) == [*BOTH, "third-below"]


def test_an_undo_below_keeps_the_part_in_a_removed_recording(
    project: Project, left: StoredRecording, right: StoredRecording
) -> None:
    draw(project, "below", right)
    draw(project, "both", left, right)
    frame = project.frames.of([right.id])[0]
    project.labels.edit(frame.id, "right-both", by_hand(frame.revision, "bob"), label="person", box=box_at(9.0))
    remove(project, left)
    project.history.undo("ann", skip=True)
    assert uids(project) == ["right-both"]
    bring_back(project, left)
    assert uids(project) == BOTH
    project.history.undo("ann")
    assert uids(project) == ["right-both"]
    assert project.history.next("ann")[0] is None


def test_a_step_that_others_have_changed_is_asked_about_again_only_in_other_recordings(
    project: Project, left: StoredRecording, right: StoredRecording
) -> None:
    for recording in (left, right):
        draw(project, "one", recording)
        draw(project, "two", recording)
        frame = project.frames.of([recording.id])[0]
        uid = f"{recording.name}-two"
        project.labels.edit(frame.id, uid, by_hand(frame.revision, "bob"), label="person", box=box_at(9.0))
    project.history.undo("ann", skip=True)
    assert uids(project) == ["left-one", "left-two", "right-two"]
    with pytest.raises(HistoryError, match="was changed by bob"):
        project.history.undo("ann")
    project.history.undo("ann", skip=True)
    assert uids(project) == ["left-two", "right-two"]
    assert project.history.next("ann")[0] is None


def test_an_action_that_is_written_in_several_calls_reaches_a_further_recording(
    project: Project, left: StoredRecording, right: StoredRecording
) -> None:
    action = new_action()
    project.log.append_to_frames([part(project, left, "both")], action)
    project.labels.create(project.frames.of([left.id])[1].id, [NewLabel("hand", box_at())], by_hand())
    assert project.history.undo("ann").words == "draw hand (frame 1)"
    assert project.history.next("ann")[0] == "draw hand (frame 0)"
    project.log.append_to_frames([part(project, right, "both")], action)
    assert project.history.next("ann") == ("draw 2 labels (frames 0 to 0)", "draw hand (frame 1)")
    remove(project, left)
    assert project.history.next("ann") == ("draw hand (frame 0)", None)
    bring_back(project, left)
    assert len(project.history.undo("ann").others) == 1
    assert uids(project) == []


def test_an_undone_action_that_goes_on_in_another_recording_can_be_undone_again(
    project: Project, left: StoredRecording, right: StoredRecording
) -> None:
    action = new_action()
    project.log.append_to_frames([part(project, left, "both")], action)
    project.history.undo("ann")
    project.log.append_to_frames([part(project, right, "both")], action)
    assert uids(project) == ["right-both"]
    project.history.undo("ann")
    assert (uids(project), project.history.next("ann")[0]) == ([], None)
    project.history.redo("ann")
    project.history.redo("ann")
    assert uids(project) == BOTH
