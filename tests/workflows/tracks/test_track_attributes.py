"""Attributes along tracks: interpolation, copies, following and linking carry them; splits and merges keep them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from threading import Lock
from typing import Any

import pytest

from annotator.project import NewLabel, Project, WriteContext
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute
from annotator.types import Box2D, BoxKind, OrientedBox, Proposal, Quality, Source, Truth
from annotator.workflows.detectors import Detectors
from annotator.workflows.tracks.copy_next import copy_next
from annotator.workflows.tracks.follow_run import follow_recording
from annotator.workflows.tracks.interpolate import interpolate
from annotator.workflows.tracks.link import link_tracks
from annotator.workflows.workbench.loaded_detectors import ReadyDetector
from annotator.workflows.workbench.save_object import copy_boxes

ANN = "ann"
TRACK = 3
SCHEMA: list[dict[str, Any]] = [
    {"name": "pose", "kind": "choice", "choices": ["sitting", "standing"]},
    {"name": "height", "kind": "number", "default": 1.7},
    {"name": "coat", "kind": "text", "of": "track"},
]
SITTING = {"pose": "sitting", "height": 1.5, "coat": "red"}
STANDING = {"pose": "standing", "height": 1.8, "coat": "red"}


@pytest.fixture
def people(people: Project) -> Project:
    for fields in SCHEMA:
        people.change_classes(partial(edit.put_attribute, attribute=Attribute.model_validate(fields)), ANN)
    return people


def by_hand(project: Project, frame_id: int) -> WriteContext:
    return WriteContext(project.frames.get(frame_id).revision, ANN)


def accept(project: Project, index: int, box: OrientedBox, track_id: int | None = TRACK, **values: Any) -> str:
    frame = project.frames.of()[index].id
    new = NewLabel("person", box, track_id=track_id, attributes=values)
    return project.labels.create(frame, [new], by_hand(project, frame)).uids[0]


def propose(project: Project, index: int, *boxes: OrientedBox) -> None:
    frame = project.frames.of()[index].id
    on_image, quality = Box2D("person", 0.0, 0.0, 9.0, 9.0), Quality(0.1, 0.9, 0.01)
    found = [Proposal("person", 0.8, box, on_image, (), quality) for box in boxes]
    project.proposals.replace(frame, found, WriteContext(project.frames.get(frame).revision, "rcv", Source.AUTO))


def along(project: Project, track_id: int = TRACK) -> list[dict[str, Any] | None]:
    """The values of a track's label in each frame."""
    by_frame = {each.frame_id: each.label for each in project.labels.select(tracks=[track_id])}
    return [dict(by_frame[frame.id].attributes) if frame.id in by_frame else None for frame in project.frames.of()]


def test_interpolated_boxes_have_the_values_of_the_nearer_key_frame(people: Project, truths: list[list[Truth]]) -> None:
    accept(people, 0, truths[0][0].box, **SITTING)
    accept(people, 4, truths[4][0].box, **STANDING)
    interpolate(people, people.recordings.all()[0].id, TRACK, ANN)
    # the middle frame is as near to both: the earlier one counts
    assert along(people) == [SITTING, SITTING, SITTING, STANDING, STANDING]
    people.history.undo(ANN)
    assert along(people) == [SITTING, None, None, None, STANDING]


def test_copies_have_all_values(people: Project, truths: list[list[Truth]]) -> None:
    frames = people.frames.of()
    uid = accept(people, 0, truths[0][0].box, **SITTING)
    copy_next(people, frames[0].id, uid, people.frames.get(frames[0].id).revision, ANN)
    copy_boxes(people, frames[2].id, frames[0].id, by_hand(people, frames[2].id))
    assert along(people)[:3] == [SITTING] * 3


@pytest.mark.parametrize("track_id", [TRACK, None])
def test_followed_boxes_have_all_values(
    people: Project, truths: list[list[Truth]], knowing: Callable[..., Detectors], track_id: int | None
) -> None:
    uid = accept(people, 0, truths[0][0].box, track_id, **SITTING)
    view = ReadyDetector(knowing("people").view, BoxKind.BOX, Lock())
    follow_recording(people, people.recordings.all()[0].id, view, ANN)
    given = people.labels.get(uid).label.track_id
    assert given is not None
    found = [each for each in along(people, given) if each is not None]
    assert len(found) >= 4 and found == [SITTING] * len(found)


def test_linked_boxes_have_the_values_of_their_track_and_keep_their_own(
    people: Project, truths: list[list[Truth]]
) -> None:
    first, second = (truth.box for truth in truths[1][:2])
    propose(people, 1, first, second)
    accept(people, 0, truths[0][0].box, **SITTING)
    link_tracks(people)
    own = {"height": 1.7}
    assert along(people)[1] == own | {"coat": "red"}
    # the reviewed box was another object: the proposal is now linked with that of a blue coat
    (reviewed,) = [each.label for each in people.labels.select() if each.label.author == ANN]
    frame = people.frames.of()[0].id
    people.labels.delete(frame, reviewed.uid, by_hand(people, frame))
    accept(people, 0, truths[0][0].box, 8, pose="sitting", coat="blue")
    link_tracks(people)
    (linked,) = [each for each in along(people, 8)[1:] if each is not None]
    assert linked == own | {"coat": "blue"}
    last = people.log.last()
    link_tracks(people)
    assert people.log.last() == last


def test_reviewed_boxes_that_contradict_their_track_stay_and_splits_and_merges_carry_values(
    people: Project, truths: list[list[Truth]]
) -> None:
    uids = [accept(people, index, truths[index][0].box, **SITTING) for index in range(3)]
    # a split: the later part gets another id, and keeps its values
    for index in (1, 2):
        give_track(people, index, uids[index], 9)
    assert [along(people), along(people, 9)] == [
        [SITTING, None, None, None, None],
        [None, SITTING, SITTING, None, None],
    ]
    frame = people.frames.of()[2].id
    people.labels.set_attributes(frame, uids[2], {"coat": "blue"}, by_hand(people, frame))
    assert [each and each["coat"] for each in along(people, 9)] == [None, "blue", "blue", None, None]
    link_tracks(people)
    assert [each and each["coat"] for each in along(people, 9)] == [None, "blue", "blue", None, None]
    # merged again: what is the same along a track is that of the track, all else stays
    for index in (1, 2):
        give_track(people, index, uids[index], TRACK)
    assert along(people)[:3] == [SITTING] * 3
    people.history.undo(ANN)
    assert along(people, 9)[2] == SITTING | {"coat": "blue"}


def give_track(project: Project, index: int, uid: str, track_id: int) -> None:
    frame = project.frames.of()[index].id
    box = project.labels.get(uid).label.box
    project.labels.edit(frame, uid, by_hand(project, frame), label="person", box=box, track_id=track_id)
