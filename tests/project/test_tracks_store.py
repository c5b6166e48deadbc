"""Track ids and their origin, and actions over several frames."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from store_samples import box_at, by_hand, by_machine, proposal_at, same_box, state_of

from annotator.project import NewLabel, Project
from annotator.project.changes import LabelChanged, LabelDeleted, Payload, TracksLinked
from annotator.project.records import BoxRecord
from annotator.types import ReviewState
from annotator.types.errors import (
    FinalisedFrameError,
    HistoryError,
    ProjectError,
    TrackTakenError,
)


def _track(project: Project, uid: str) -> tuple[int | None, bool]:
    stored = project.labels.get(uid)
    return stored.label.track_id, stored.track_linked


def test_track_ids_record_whether_they_come_from_linking_or_an_operator(project: Project, frame: int) -> None:
    (uid,) = project.proposals.replace(frame, [proposal_at()], by_machine(), track_ids=[4]).uids
    assert uid is not None
    assert _track(project, uid) == (4, True)
    project.labels.edit(frame, uid, by_hand(1), label="hand", box=box_at(1.0), track_id=4)
    assert _track(project, uid) == (4, True), "an edit of the box does not confirm the track"
    project.labels.edit(frame, uid, by_hand(2), label="hand", box=box_at(1.0), track_id=5)
    assert _track(project, uid) == (5, False)
    project.log.append(frame, [TracksLinked(labels=(LabelChanged(uid=uid, track_id=6),))], by_machine(3))
    assert _track(project, uid) == (6, True)
    project.log.append(frame, [LabelChanged(uid=uid, track_id=None)], by_hand(4))
    assert _track(project, uid) == (None, False)
    assert project.history.next("ann")[0] == "track hand (frame 2)"
    project.history.undo("ann")
    assert _track(project, uid) == (6, True)
    assert project.labels.get(uid).label.state is ReviewState.EDITED


def test_linking_changes_no_reviewed_box_and_no_finalised_frame(project: Project, frame: int) -> None:
    (uid,) = project.labels.create(frame, [NewLabel("hand", box_at())], by_hand()).uids
    moved = TracksLinked(labels=(LabelChanged(uid=uid, track_id=1, box=BoxRecord.of(box_at(2.0))),))
    with pytest.raises(ProjectError, match="has been reviewed"):
        project.log.append(frame, [moved], by_machine(1))
    assert same_box(project.labels.get(uid).label.box, box_at())
    project.frames.finalise(frame, by_hand(1))
    with pytest.raises(FinalisedFrameError):
        project.log.append(frame, [TracksLinked(labels=(LabelChanged(uid=uid, track_id=1),))], by_machine(2))
    # linking is automatic and cannot be undone
    assert project.history.next("ann")[0] == "finalise frame 2"


@pytest.fixture
def three(project: Project, frame: int) -> tuple[str, str, str]:
    """Uids of a frame's boxes: of track 1, of none, and a rejected one of track 1."""
    free, right, gone = (NewLabel("hand", box_at(x)) for x in (3.0, 0.0, 6.0))
    uids = project.labels.create(frame, [right, free, gone], by_hand()).uids
    project.labels.edit(frame, uids[2], by_hand(3), label="hand", box=box_at(6.0), track_id=1)
    project.labels.reject(frame, uids[2], by_hand(4))
    project.log.append(frame, [LabelChanged(uid=uids[0], track_id=1)], by_hand(5))
    return uids[0], uids[1], uids[2]


BOX = BoxRecord.of(box_at(9.0))


@pytest.mark.parametrize(
    "change",
    [
        lambda uids: LabelChanged(uid=uids[1], track_id=1),
        lambda uids: NewLabel("person", box_at(), track_id=1, state=ReviewState.PROPOSED),
        lambda uids: LabelChanged(uid=uids[2], state=ReviewState.ACCEPTED),
        lambda uids: TracksLinked(labels=(LabelChanged(uid=uids[1], track_id=1),)),
    ],
    ids=["tracked", "proposed", "a rejected one accepted", "linked"],
)
def test_no_change_gives_a_track_a_second_box_in_a_frame(
    project: Project, frame: int, three: tuple[str, str, str], change: Callable[[tuple[str, str, str]], Payload]
) -> None:
    before = state_of(project)
    with pytest.raises(TrackTakenError, match=r"frame 2 of .*: track 1 has a box in this frame already") as refused:
        project.log.append(frame, [change(three)], by_hand(6))
    assert refused.value.track_id == 1
    assert state_of(project) == before
    # the same, if the other box goes
    project.log.append(frame, [LabelDeleted(uid=three[0]), change(three)], by_hand(6))


def test_boxes_can_change_their_tracks_with_each_other(
    project: Project, frame: int, three: tuple[str, str, str]
) -> None:
    project.log.append(frame, [LabelChanged(uid=three[1], track_id=2)], by_hand(6))
    swap = [LabelChanged(uid=three[0], track_id=2), LabelChanged(uid=three[1], track_id=1)]
    project.log.append(frame, swap, by_hand(7))
    assert [_track(project, uid)[0] for uid in three] == [2, 1, 1]


def test_a_rejected_label_gives_its_track_to_one_that_was_rejected(project: Project, frame: int, three) -> None:
    right, free, gone = three
    project.log.append(frame, [LabelChanged(uid=right, track_id=2)], by_hand(6))
    back = [LabelChanged(uid=gone, track_id=2), LabelChanged(uid=gone, state=ReviewState.ACCEPTED)]
    # the same columns change as of the label that comes back, and others of the one whose track it gets
    as_well = [LabelChanged(uid=free, track_id=5), LabelChanged(uid=free, state=ReviewState.REJECTED)]
    project.log.append(frame, [*as_well, LabelChanged(uid=right, state=ReviewState.REJECTED), *back], by_hand(7))
    assert [_track(project, uid)[0] for uid in three] == [2, 5, 2]
    project.history.undo("ann")
    assert [_track(project, uid)[0] for uid in three] == [2, None, 1]


def test_an_undo_that_would_give_a_track_a_second_box_is_refused_and_can_be_skipped(
    project: Project, frame: int, three: tuple[str, str, str]
) -> None:
    project.labels.create(frame, [NewLabel("person", box_at(12.0))], by_hand(6))
    project.labels.reject(frame, three[0], by_hand(7))
    project.log.append(frame, [LabelChanged(uid=three[1], track_id=1)], by_hand(8, "bob"))
    before = state_of(project)
    with pytest.raises(HistoryError, match="track 1 has a box in this frame already") as refused:
        project.history.undo("ann")
    assert refused.value.frame_id == frame
    assert state_of(project) == before
    # the one before is undone
    assert project.history.undo("ann", skip=True).words == "draw person (frame 2)"


def test_a_pass_gives_a_track_once_and_not_that_of_a_reviewed_box(project: Project, frame: int) -> None:
    states = (ReviewState.ACCEPTED, ReviewState.REJECTED)
    made = [NewLabel("hand", box_at(9.0 * n), track_id=n, state=state) for n, state in enumerate(states)]
    project.labels.create(frame, made, by_hand())
    found = [proposal_at(x) for x in (0.0, 3.0, 6.0, 12.0, 15.0)]
    uids = project.proposals.replace(frame, found, by_machine(2), track_ids=[4, 4, 4, 0, 1]).uids
    # the first one is covered
    assert uids[0] is None
    assert [_track(project, uid) for uid in uids if uid] == [(4, True), (None, False), (None, False), (1, True)]


@pytest.mark.parametrize("is_ours", [True, False], ids=["ours has the track", "a reviewed box has it"])
def test_boxes_of_other_software_get_no_track_of_another_box(project: Project, frame: int, is_ours: bool) -> None:
    def theirs() -> dict[float, int | None]:
        boxes = [NewLabel("hand", box_at(x), 0.3, 4) for x in (6.0, 9.0)]
        project.proposals.bring("lidar", {frame: boxes})
        return {label.box.center_m[0]: label.track_id for label in project.labels.of_frame(frame)}

    assert theirs() == {6.0: 4, 9.0: None}, "the second box of its track has none"
    change = (by_machine if is_ours else by_hand)(project.frames.get(frame).revision)
    if is_ours:
        project.proposals.replace(frame, [proposal_at()], change, track_ids=[4])
    else:
        project.proposals.bring("lidar", {frame: []})
        change = by_hand(project.frames.get(frame).revision)
        project.labels.create(frame, [NewLabel("hand", box_at(), track_id=4)], change)
    assert list(theirs().values()).count(4) == 1
