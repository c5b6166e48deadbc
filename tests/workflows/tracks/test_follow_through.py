"""Followed objects go on through reviewed boxes, stop at those of others, and leave nothing stale."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from moving import ANN, Walking, accept, box_of, labels_of, proposal_of, tracks_of

from annotator.geometry.iou import iou_3d
from annotator.project import NewLabel, Project, WriteContext
from annotator.project.changes import LabelChanged
from annotator.types import ReviewState, Source
from annotator.workflows.tracks.follow_run import Following, follow_from_frame, follow_recording
from annotator.workflows.workbench.save_object import copy_boxes


def follow(
    project: Project, walking: Walking, index: int, uid: str | None = None, *, forward: bool = True
) -> Following:
    frame = project.frames.of()[index]
    with walking.followed():
        return follow_from_frame(project, frame.id, frame.revision, None, ANN, uid=uid, forward=forward).run()


def follow_all(project: Project, walking: Walking, **options: Any) -> Following:
    with walking.followed():
        return follow_recording(project, project.recordings.all()[0].id, None, ANN, **options)


@pytest.mark.parametrize(
    ("start", "forward", "expected"),
    [
        (0, True, ["1", "1?", "1", "1?", "1"]),
        (2, True, ["-", "", "1", "1?", "1"]),
        (4, False, ["1", "1?", "1", "1?", "1"]),
    ],
)
def test_reviewed_boxes_on_the_way_become_one_track(
    people: Project, start: int, forward: bool, expected: list[str]
) -> None:
    uids = [*accept(people, 0, 0), *accept(people, 2, 0), *accept(people, 4, 0)]
    before = tracks_of(people)
    done = follow(people, Walking(drift_m=0.1), start, forward=forward)
    assert tracks_of(people) == expected
    (track,) = done.tracks
    assert (track.track_id, track.boxes, track.stops) == (1, sum("?" in each for each in expected), ())
    assert done.done == done.total
    for uid, index in zip(uids, (0, 2, 4), strict=True):
        label = people.labels.get(uid).label
        assert label.state is ReviewState.ACCEPTED
        assert np.array_equal(label.box.pose, box_of(0, index).pose)
    people.history.undo(ANN)
    assert tracks_of(people) == before


def test_between_reviewed_boxes_without_a_track_both_directions_count(people: Project) -> None:
    accept(people, 0, 0)
    accept(people, 4, 0)
    follow(people, Walking(drift_m=0.08), 0)
    assert tracks_of(people) == ["1", "1?", "1?", "1?", "1"]
    offs = [
        round(float(labels_of(people, index)[0].box.center_m[0] - box_of(0, index).center_m[0]), 2)
        for index in (1, 2, 3)
    ]
    assert offs == [0.08, 0.16, -0.08], "each from the nearer reviewed box"


@pytest.mark.parametrize("track", [None, 1])
def test_no_box_is_left_out_before_a_reviewed_one_that_was_reached(people: Project, track: int | None) -> None:
    accept(people, 0, (0, track))
    accept(people, 4, (0, track))
    # off by 0.28 m there, half of the width; so are the boxes of both directions from each other
    (done,) = follow(people, Walking(drift_m=0.07), 0).tracks
    assert (done.boxes, done.doubtful, done.stops) == (3, 0, ())
    people.history.undo(ANN)
    # the other way, or again
    (done,) = follow(people, Walking(drift_m=0.07, lost={(0, 0)}), 4, forward=False).tracks
    assert (done.boxes, done.doubtful, done.stops) == (3, 0, ())
    (done,) = follow(people, Walking(drift_m=0.07), 0).tracks
    assert (done.boxes, done.doubtful, done.stops) == (3, 0, ())
    people.history.undo(ANN)
    people.history.undo(ANN)
    # it is expected there, but not found
    (done,) = follow(people, Walking(drift_m=0.07, lost={(0, 0), (0, 4)}), 0).tracks
    assert (done.boxes, done.doubtful, done.stops) == (0, 3, ())


def test_what_both_directions_do_not_agree_on_is_left_out(people: Project) -> None:
    accept(people, 0, 0)
    accept(people, 3, 0)
    (track,) = follow(people, Walking(drift_m=0.25, lost={(0, 3)}), 0).tracks
    assert tracks_of(people) == ["1", "", "", "1", "1?"]
    assert (track.boxes, track.doubtful, track.stops) == (1, 2, ())


@pytest.mark.parametrize("off_m", [0.0, 0.25])
def test_a_reviewed_box_is_met_where_the_object_should_be_although_it_is_not_found(
    people: Project, off_m: float
) -> None:
    accept(people, 0, 0)
    frame = people.frames.of()[2]
    people.labels.create(frame.id, [NewLabel("person", box_of(0, 2, off_m))], WriteContext(frame.revision, ANN))
    follow(people, Walking(lost={(0, 2)}), 0)
    assert tracks_of(people) == ["1", "1?", "1", "1?", "1?"]


def test_an_object_stops_at_a_reviewed_box_of_another_track(people: Project) -> None:
    accept(people, 0, (0, 1))
    accept(people, 3, (0, 2))
    (track,) = follow(people, Walking(), 0).tracks
    assert tracks_of(people) == ["1", "1?", "1?", "2", ""]
    (stop,) = track.stops
    assert stop.key == people.frames.of()[3].key
    assert stop.reason.startswith("a box of track 2 is here; if it is the same object, give both one track")


def test_the_same_track_elsewhere_in_the_frame_keeps_its_box(people: Project) -> None:
    (uid,) = accept(people, 0, 0)
    accept(people, 3, (1, 1))
    (track,) = follow(people, Walking(), 0).tracks
    # 1 is in use
    assert tracks_of(people) == ["2", "2?", "2?", "2? 1", "2?"]
    assert track.track_id == people.labels.get(uid).label.track_id == 2


def test_a_new_run_leaves_nothing_of_an_earlier_one_where_it_passes(people: Project) -> None:
    (uid,) = accept(people, 0, 0)
    # the first run takes another person for this one
    follow(people, Walking(taken_for={(0, 2): 1}), 0)
    accept(people, 2, 0)
    assert tracks_of(people) == ["1", "1?", "- 1?", "1?", "1?"]
    (track,) = follow(people, Walking(lost={(0, 3)}), 0, uid).tracks
    # nor beyond the frame in which it stops
    assert tracks_of(people) == ["1", "1?", "1", "", ""]
    assert [stop.key for stop in track.stops] == [people.frames.of()[3].key]


@pytest.mark.parametrize(
    ("start", "lost", "between"), [(0, [1], ["", "1?"]), (3, [2], ["1?", ""]), (0, [1, 2], ["", ""])]
)
def test_a_new_run_leaves_nothing_of_an_earlier_one_up_to_the_next_reviewed_box(
    people: Project, start: int, lost: list[int], between: list[str]
) -> None:
    (uid,) = accept(people, 0, (0, 1))
    follow(people, Walking(), 0, uid)
    frame, (label,) = people.frames.of()[3], labels_of(people, 3)
    people.labels.accept(frame.id, label.uid, WriteContext(frame.revision, ANN))
    assert tracks_of(people) == ["1", "1?", "1?", "1", "1?"]
    (track,) = follow(people, Walking(lost={(0, index) for index in lost}), start, forward=start == 0).tracks
    assert not track.is_open
    assert tracks_of(people) == ["1", *between, "1", "1?"]


@pytest.mark.parametrize("lost", [1, 2])
def test_a_copy_stays_where_the_object_is_lost_and_beyond(people: Project, lost: int) -> None:
    (uid,) = accept(people, 0, (0, 1))
    for index in (1, 2, 3):
        frame = people.frames.of()[index]
        copy_boxes(people, frame.id, people.frames.of()[0].id, WriteContext(frame.revision, ANN))
    copies = [labels_of(people, index)[0].uid for index in (1, 2, 3)]
    (track,) = follow(people, Walking(lost={(0, lost)}), 0, uid).tracks
    assert track.is_open
    assert tracks_of(people) == ["1", "1?", "1?", "1?", ""]
    kept = [labels_of(people, index)[0].uid in copies for index in (1, 2, 3)]
    assert kept == [index >= lost for index in (1, 2, 3)]


def test_a_stopped_run_removes_nothing_where_it_has_not_looked(people: Project) -> None:
    (uid,) = accept(people, 0, (0, 1))
    follow(people, Walking(), 0, uid)
    frame, asked = people.frames.of()[0], iter([False, False, True, True])
    with Walking(drift_m=0.1).followed():
        follow_from_frame(people, frame.id, frame.revision, None, ANN).run(stopped=lambda: next(asked))
    assert tracks_of(people) == ["1", "1?", "1?", "1?", "1?"]


def test_what_a_pass_has_found_stays_where_following_finds_nothing(people: Project) -> None:
    accept(people, 0, (0, 1))
    frame = people.frames.of()[2]
    found = [proposal_of(box_of(0, 2))]
    people.proposals.replace(frame.id, found, WriteContext(0, "rcv", Source.AUTO), track_ids=[1])
    follow(people, Walking(lost={(0, 2)}), 0)
    assert tracks_of(people) == ["1", "1?", "1?", "", ""]


def test_two_followed_objects_do_not_become_one(people: Project) -> None:
    accept(people, 0, 0, 1)
    done = follow(people, Walking(taken_for={(1, 2): 0}), 0)
    assert tracks_of(people) == ["1 2", "1? 2?", "1?", "1?", "1?"]
    assert [track.boxes for track in done.tracks] == [4, 1]
    assert [len(track.stops) for track in done.tracks] == [0, 1]


def test_a_proposal_that_a_person_has_given_another_track_is_not_replaced(people: Project) -> None:
    accept(people, 0, (0, 1))
    frame = people.frames.of()[2]
    (uid,) = people.proposals.replace(frame.id, [proposal_of(box_of(0, 2))], WriteContext(0, "rcv", Source.AUTO)).uids
    assert uid is not None
    people.log.append(frame.id, [LabelChanged(uid=uid, track_id=9)], WriteContext(1, "bob"))
    (track,) = follow(people, Walking(), 0).tracks
    assert tracks_of(people) == ["1", "1?", "9?", "", ""]
    assert track.stops[0].reason.startswith("a box of track 9 is here")


def test_boxes_of_a_reviewed_frame_are_followed_both_ways_by_the_command(people: Project) -> None:
    accept(people, 2, 0)
    follow_all(people, Walking(), backward=True)
    assert tracks_of(people) == ["1?", "1?", "1", "1?", "1?"]
    for index in (0, 4):
        assert iou_3d(labels_of(people, index)[0].box, box_of(0, index)) > 0.9


def test_only_the_given_tracks_are_followed_in_the_given_direction(people: Project) -> None:
    accept(people, 2, (0, 1), (1, 2))
    follow_all(people, Walking(), tracks=[2], forward=False, backward=True)
    assert tracks_of(people) == ["2?", "2?", "1 2", "", ""]
