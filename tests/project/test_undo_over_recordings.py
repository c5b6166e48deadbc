"""Undo and redo of actions over several recordings, some of which are removed and come back."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from store_samples import box_at, by_hand

from annotator.project import FramePart, NewLabel, Project, StoredRecording
from annotator.project.backup.verify import verify
from annotator.project.log import new_action
from annotator.types.errors import HistoryError

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
    assert project.history.next("ann") == ("draw 2 labels (frames 0 to 0)", "draw hand (frame 0)")
    assert (project.history.undo("ann").words, uids(project)) == ("draw 2 labels (frames 0 to 0)", [])
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
    assert project.history.undo("ann").words == "draw hand (frame 1)"
    draw(project, "both", [right], action)
    assert project.history.next("ann") == ("draw 2 labels (frames 0 to 0)", "draw hand (frame 1)")
    assert (project.history.undo("ann").words, uids(project)) == ("draw 2 labels (frames 0 to 0)", [])
    with pytest.raises(HistoryError, match="it was undone while it was running"):
        draw(project, "both", [third], action)
    project.history.redo("ann")
    assert uids(project) == BOTH
