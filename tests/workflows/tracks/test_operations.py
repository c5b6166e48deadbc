"""Whole tracks, or spans of them: each operation is counted before it happens, and is one undoable action."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from moving import ANN, SIZE_M, box_of
from true_room import Room

from annotator.project import FramePart, NewLabel
from annotator.project.changes import LabelChanged
from annotator.project.classes.attributes import Attribute
from annotator.project.classes.edit import PutAttribute
from annotator.project.records import BoxRecord
from annotator.types import Label, OrientedBox, ReviewState
from annotator.types.errors import ConfigError, NotFoundError, TrackTakenError
from annotator.workflows.tracks import operations, timeline
from annotator.workflows.tracks.operations import Delete, Merge, SetClass, SetNumber, SetSize, SetValues, apply, resized
from annotator.workflows.tracks.steps import Count
from annotator.workflows.workbench.save_object import apply_changes

OPEN, ACCEPTED = ReviewState.PROPOSED, ReviewState.ACCEPTED


def put(room: Room, index: int, state: ReviewState = OPEN, track_id: int = 3, person: int = 0, **more: Any) -> str:
    """Gives a track a box in a frame; returns its label."""
    box = more.pop("box", None) or box_of(person, index)
    new = NewLabel("person", box, track_id=track_id, state=state, **more)
    return room.project.labels.create(room.frames[index].id, [new], room.context(index)).uids[0]


@pytest.fixture
def track(room: Room) -> Room:
    """Track 3 has a box in each of five frames: reviewed, open, open, reviewed, open."""
    for index, state in enumerate((ACCEPTED, OPEN, OPEN, ACCEPTED, OPEN)):
        put(room, index, state)
    return room


def do(room: Room, operation: operations.Operation, track_id: int = 3, **options: Any) -> Count:
    return apply(room.project, room.recording, track_id, operation, ANN, **options).count


def of_track(room: Room, track_id: int = 3) -> list[tuple[int, Label]]:
    frames = {frame.id: index for index, frame in enumerate(room.frames)}
    return [(frames[each.frame_id], each.label) for each in room.project.labels.along(1, tracks=[track_id])]


def test_a_class_is_set_once_the_operator_knows_what_it_changes(track: Room) -> None:
    track.project.configure(classes=("person", "robot"))
    told = do(track, SetClass(label="robot"), dry_run=True)
    assert told == Count(changed=5, reviewed=2)
    assert told.words() == "changes 5 boxes, 2 of them reviewed"
    assert {label.label for _, label in of_track(track)} == {"person"}, "it was only counted"
    # somebody reviews one more in the meantime
    uid = of_track(track)[1][1].uid
    track.project.labels.accept(track.frames[1].id, uid, track.context(1, "bob"))
    with pytest.raises(ConfigError, match="in the meantime: this now changes 5 boxes, 3 of them reviewed"):
        do(track, SetClass(label="robot"), told=told)
    told = do(track, SetClass(label="robot"), dry_run=True)
    assert do(track, SetClass(label="robot"), told=told, at=track.frames[2].id) == told
    states = [label.state for _, label in of_track(track)]
    assert states == [ReviewState.EDITED] * 2 + [OPEN, ReviewState.EDITED, OPEN], "what was open is open"
    assert {label.label for _, label in of_track(track)} == {"robot"}
    done = track.project.history.undo(ANN)
    assert done.frame_id == track.frames[2].id, "the operator stays there"
    assert {label.label for _, label in of_track(track)} == {"person"}
    with pytest.raises(NotFoundError, match="no class 'robt'; did you mean 'robot'"):
        do(track, SetClass(label="robt"))
    with pytest.raises(ConfigError, match="there is nothing to change"):
        do(track, SetClass(label="person"))


def test_a_track_is_split_and_merged_again(track: Room) -> None:
    split = do(track, SetNumber(first=track.frames[2].id))
    assert split == Count(changed=3, reviewed=1, number=4)
    assert split.words() == "changes 3 boxes, 1 of them reviewed; their number is 4, a new one"
    assert [[index for index, _ in of_track(track, number)] for number in (3, 4)] == [[0, 1], [2, 3, 4]]
    # the same object was reviewed once more, and is to be one track again
    put(track, 0, OPEN, 4)
    reviewed = put(track, 1, ACCEPTED, 4, person=1)
    put(track, 3, ACCEPTED, 3, person=1)
    merged = do(track, SetNumber(number=4))
    # frame 0: this one is reviewed; frame 1: the other one is; frame 3: both are, so that of this track stays
    assert merged == Count(changed=2, deleted=3, reviewed=3, number=4, joined=5)
    assert of_track(track, 3) == []
    stays = dict(of_track(track, 4))
    assert sorted(stays) == [0, 1, 2, 3, 4]
    assert (stays[0].state, stays[1].uid) == (ACCEPTED, reviewed)
    assert np.allclose(stays[3].box.center_m, box_of(1, 3).center_m)
    track.project.history.undo(ANN)
    assert [len(of_track(track, number)) for number in (3, 4)] == [3, 5]
    with pytest.raises(ConfigError, match="has this number already"):
        do(track, SetNumber(number=3))


def test_the_likeliest_other_part_of_a_track_is_proposed(room: Room) -> None:
    room.project.configure(classes=("person", "robot"))
    for index in (0, 1):
        put(room, index)
    with pytest.raises(ConfigError, match="no other part of track 3 of people was found"):
        do(room, Merge(), dry_run=True)
    put(room, 4, track_id=5)  # where it would be by now
    put(room, 3, track_id=6, person=1)  # beside it
    put(room, 1, track_id=7)
    put(room, 3, track_id=7)  # in a frame with this one: another object
    put(room, 2, track_id=8, box=box_of(0, 2))
    uid = of_track(room, 8)[0][1].uid
    room.project.log.append(room.frames[2].id, [LabelChanged(uid=uid, label="robot")], room.context(2))
    told = do(room, Merge(), dry_run=True)
    assert told == Count(changed=2, number=5, joined=1)
    assert do(room, Merge(number=told.number), told=told) == told
    assert [index for index, _ in of_track(room, 5)] == [0, 1, 4]


def test_a_new_number_that_somebody_else_has_just_taken_is_refused(
    track: Room, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(type(track.project.labels), "next_track_id", lambda *_: 9)
    put(track, 0, ACCEPTED, 9, person=1)
    with pytest.raises(TrackTakenError):
        do(track, SetNumber(first=track.frames[2].id))
    assert [index for index, _ in of_track(track)] == [0, 1, 2, 3, 4]


def test_finalised_frames_stay_and_rejected_boxes_do_not_count(track: Room) -> None:
    track.project.frames.finalise(track.frames[1].id, track.context(1))
    uid = of_track(track)[2][1].uid
    track.project.labels.reject(track.frames[2].id, uid, track.context(2))
    gone = do(track, Delete(first=track.frames[1].id, last=track.frames[3].id))
    assert gone == Count(deleted=1, reviewed=1, finalised=1)
    assert gone.words() == "deletes 1 box, 1 of them reviewed; unchanged: 1 in finalised frames"
    assert [index for index, _ in of_track(track)] == [0, 1, 2, 4]
    with pytest.raises(ConfigError, match="the span ends before it begins"):
        do(track, Delete(first=track.frames[3].id, last=track.frames[1].id))
    with pytest.raises(NotFoundError, match="people has no frame with id 99"):
        do(track, Delete(first=99))


def test_an_open_box_does_not_become_one_that_covers_a_reviewed_one(track: Room) -> None:
    track.project.configure(classes=("person", "robot"))
    frame = track.frames[1].id
    new = NewLabel("robot", box_of(0, 1))
    track.project.labels.create(frame, [new], track.context(1))
    assert do(track, SetClass(label="robot")) == Count(changed=4, reviewed=2, covered=1)
    assert [label.label for _, label in of_track(track)] == ["robot", "person", "robot", "robot", "robot"]


def test_one_size_keeps_the_bottom_and_the_sides_that_face_the_camera(track: Room) -> None:
    size_m = (0.8, 0.7, 1.5)
    assert do(track, SetSize(size_m=size_m)) == Count(changed=5, reviewed=2, size_m=size_m)
    assert all(np.allclose(label.box.size_m, size_m) for _, label in of_track(track))
    assert all(np.allclose(label.box.rotation, np.eye(3)) for _, label in of_track(track))

    def faces(box: OrientedBox) -> np.ndarray:
        return np.stack([box.center_m - box.size_m / 2, box.center_m + box.size_m / 2])

    # of a box to the right: its left side; the camera is between those along y
    was = OrientedBox.from_parts(np.array([5.0, 0.1, 4.0]), np.eye(3), SIZE_M)
    now = resized(was, size_m)
    stays = np.isclose(faces(was), faces(now))
    assert stays.tolist() == [[True, False, True], [False, False, False]]
    assert now.center_m[1] == was.center_m[1]


def test_the_size_of_a_track_is_fitted_to_its_boxes_and_the_points_of_their_frames(room: Room) -> None:
    """One side of each box is too short for its points: no side of the common size is."""
    shrunk = [(0.6, 1, 1), (1, 0.6, 1), (1, 1, 0.6), (0.6, 1, 1), (1, 0.6, 1)]
    for index, factors in enumerate(shrunk):
        box = room.box(index)
        put(room, index, box=OrientedBox.from_parts(box.center_m, box.rotation, box.size_m * factors))
    told = apply(room.project, room.recording, 3, SetSize(), ANN, dry_run=True)
    assert isinstance(told.operation, SetSize)
    size_m = told.count.size_m
    assert size_m is not None and told.count == Count(changed=5, size_m=size_m)
    assert f"they get {size_m[0]:.2f} x " in told.count.words()
    # what was told is done, and is one step back
    assert do(room, told.operation, told=told.count).size_m == size_m
    assert all(np.allclose(label.box.size_m, size_m) for _, label in of_track(room))
    mean_m = np.mean([room.box(index).size_m for index in range(5)], axis=0)
    assert (np.abs(size_m / mean_m - 1) < np.abs(np.mean(shrunk, axis=0) - 1)).all()
    room.project.history.undo(ANN)
    # where boxes are reviewed, only they say it
    uid = of_track(room)[2][1].uid
    large = BoxRecord.of(OrientedBox.from_parts(room.box(2).center_m, room.box(2).rotation, np.array([1.5, 1.2, 2.5])))
    edit = LabelChanged(uid=uid, state=ReviewState.EDITED, box=large)
    room.project.log.append(room.frames[2].id, [edit], room.context(2))
    assert do(room, SetSize(), dry_run=True).size_m == (1.5, 1.2, 2.5)


def test_boxes_that_an_action_adds_have_the_value_that_it_gave_their_track_before(room: Room) -> None:
    coat = Attribute.model_validate({"name": "coat", "kind": "text", "of": "track"})
    room.project.change_classes(PutAttribute(attribute=coat), ANN)
    first, second = (NewLabel("person", box_of(0, index), track_id=3) for index in (0, 1))
    red = LabelChanged(uid=first.uid, attributes={"coat": "red"})
    room.project.log.append_to_frames(
        [
            FramePart(room.frames[0].id, [first, red], room.context(0)),
            FramePart(room.frames[1].id, [second], room.context(1)),
        ]
    )
    assert [label.attributes for _, label in of_track(room)] == [{"coat": "red"}] * 2


def test_values_are_set_along_a_track(track: Room) -> None:
    for fields in (
        {"name": "pose", "kind": "choice", "choices": ["sitting", "standing"]},
        {"name": "coat", "kind": "text", "of": "track"},
    ):
        track.project.change_classes(PutAttribute(attribute=Attribute.model_validate(fields)), ANN)
    second = track.frames[1].id
    assert do(track, SetValues(first=second, values={"pose": "sitting"})) == Count(changed=4, reviewed=1)
    assert do(track, SetValues(values={"pose": "sitting", "coat": "red"})).changed == 5
    assert {tuple(sorted(label.attributes.items())) for _, label in of_track(track)} == {
        (("coat", "red"), ("pose", "sitting"))
    }
    track.project.history.undo(ANN)
    # the value of a track does not keep its proposals from being replaced by a pass; one of a box does
    kept = [track.project.labels.kept(frame.id) for frame in track.frames]
    assert [len(uids) for uids in kept] == [0, 1, 1, 0, 1]
    track.project.history.undo(ANN)
    do(track, SetValues(values={"coat": "red"}), at=second)
    assert [len(track.project.labels.kept(frame.id)) for frame in track.frames] == [0, 1, 0, 0, 0]
    for values, why in (
        ({"coat": "blue"}, "attribute of tracks"),
        ({"pose": "flying"}, "pose must be one of sitting, standing"),
        ({"colour": 1}, "no attribute 'colour'"),
    ):
        with pytest.raises((ConfigError, NotFoundError), match=why):
            do(track, SetValues(first=second, values=values))


# --- key frames: what a correction moves ------------------------------------------------------------------------------


def correct(room: Room, index: int, by_m: float, *, flip: bool = False) -> int:
    """Moves the box of track 3 in a frame, as the page does; returns how many boxes have moved along."""
    (label,) = (label for place, label in of_track(room) if place == index)
    turn = np.diag([-1.0, -1.0, 1.0]) if flip else np.eye(3)
    center_m = label.box.center_m + np.array([0.0, 0.0, by_m])
    box = BoxRecord.of(OrientedBox.from_parts(center_m, label.box.rotation @ turn, label.box.size_m))
    edit = LabelChanged(uid=label.uid, state=ReviewState.EDITED, box=box)
    return apply_changes(room.project, room.frames[index].id, [edit], room.context(index), pytest.fail)


def moved_m(room: Room) -> list[float]:
    return [round(float(label.box.center_m[2] - box_of(0, index).center_m[2]), 6) for index, label in of_track(room)]


def test_open_boxes_move_with_a_corrected_one_up_to_the_reviewed_ones(room: Room) -> None:
    for index, state in enumerate((ACCEPTED, OPEN, OPEN, OPEN, ACCEPTED)):
        put(room, index, state)
    assert correct(room, 2, 0.4) == 2
    assert moved_m(room) == [0.0, 0.2, 0.4, 0.2, 0.0]
    assert [label.state for _, label in of_track(room)] == [ACCEPTED, OPEN, ReviewState.EDITED, OPEN, ACCEPTED]
    # the next correction begins where this one ends
    assert correct(room, 1, 0.1) == 0
    assert correct(room, 2, 0.2) == 1
    assert moved_m(room) == [0.0, 0.3, 0.6, 0.3, 0.0]
    # and all of a correction is one step back
    room.project.history.undo(ANN)
    room.project.history.undo(ANN)
    assert moved_m(room) == [0.0, 0.2, 0.4, 0.2, 0.0]
    room.project.history.undo(ANN)
    assert moved_m(room) == [0.0] * 5


def test_without_a_reviewed_box_all_of_a_side_moves_alike_but_not_in_finalised_frames(room: Room) -> None:
    for index in range(5):
        put(room, index)
    room.project.frames.finalise(room.frames[3].id, room.context(3))
    assert correct(room, 1, 0.3) == 3
    assert moved_m(room) == [0.3, 0.3, 0.3, 0.0, 0.3]
    # what was corrected is reviewed now, so only the other side follows
    assert correct(room, 2, 0.2) == 1
    assert moved_m(room) == [0.3, 0.3, 0.5, 0.0, 0.5]
    room.project.history.undo(ANN)
    room.project.history.undo(ANN)
    assert moved_m(room) == [0.0] * 5


def test_the_shares_of_boxes_are_by_the_times_of_their_frames(room: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    for index, state in enumerate((ACCEPTED, OPEN, OPEN, OPEN, ACCEPTED)):
        put(room, index, state)
    times_ns = dict(zip((frame.key for frame in room.frames), (0, 1, 2, 8, 10), strict=True))
    monkeypatch.setattr(timeline, "recorded_times", lambda _: times_ns)
    assert correct(room, 2, 0.4) == 2
    assert moved_m(room) == [0.0, 0.2, 0.4, 0.1, 0.0]


@pytest.mark.parametrize("end", [ACCEPTED, OPEN])
def test_where_only_the_corrected_box_was_wrong_the_others_stay(room: Room, end: ReviewState) -> None:
    for index, state in enumerate((end, OPEN, OPEN, OPEN, end)):
        box = box_of(0, index)
        off = OrientedBox.from_parts(box.center_m + np.array([0.0, 0.0, 1.0]), box.rotation, box.size_m)
        put(room, index, state, box=off if index == 2 else box)
    assert correct(room, 2, -1.0) == 0
    assert moved_m(room) == [0.0] * 5
    room.project.history.undo(ANN)
    assert moved_m(room) == [0.0, 0.0, 1.0, 0.0, 0.0]


@pytest.mark.parametrize("start", [ACCEPTED, OPEN])
def test_a_heading_that_is_turned_round_turns_those_that_were_wrong_alike(room: Room, start: ReviewState) -> None:
    back = np.diag([-1.0, -1.0, 1.0])
    for index, state in enumerate((start, OPEN, OPEN, OPEN, ACCEPTED)):
        box = box_of(0, index)
        # the earlier ones face the wrong way
        rotation = back if index in (1, 2) else np.eye(3)
        put(room, index, state, box=OrientedBox.from_parts(box.center_m, rotation, box.size_m))
    assert correct(room, 2, 0.0, flip=True) == 1
    assert all(np.allclose(label.box.rotation, np.eye(3)) for _, label in of_track(room))
