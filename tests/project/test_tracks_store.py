"""Track ids and their origin, and actions over several frames."""

from __future__ import annotations

import pytest
from store_samples import box_at, by_hand, by_machine, proposal_at, same_box, state_of

from annotator.project import Effort, FramePart, NewLabel, Project, StoredRecording
from annotator.project.event_types import (
    LabelDeleted,
    LabelProposed,
    LabelTracked,
    LinkedLabel,
    ProposedObject,
    TracksLinked,
)
from annotator.project.records import BoxRecord, ProposalRecord
from annotator.types import ReviewState, Source
from annotator.types.errors import FinalisedFrameError, HistoryError, ProjectError, StaleRevisionError


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
    project.log.append(frame, [TracksLinked(labels=(LinkedLabel(uid=uid, track_id=6),))], by_machine(3))
    assert _track(project, uid) == (6, True)
    project.log.append(frame, [LabelTracked(uid=uid, track_id=None)], by_hand(4))
    assert _track(project, uid) == (None, False)
    assert project.history.next("ann")[0] == "track hand (frame 2)"
    project.history.undo("ann")
    assert _track(project, uid) == (6, True)
    assert project.labels.get(uid).label.state is ReviewState.EDITED


def test_linking_changes_no_reviewed_box_and_no_finalised_frame(project: Project, frame: int) -> None:
    (uid,) = project.labels.create(frame, [NewLabel("hand", box_at())], by_hand()).uids
    moved = TracksLinked(labels=(LinkedLabel(uid=uid, track_id=1, box=BoxRecord.of(box_at(2.0))),))
    with pytest.raises(ProjectError, match="has been reviewed"):
        project.log.append(frame, [moved], by_machine(1))
    assert same_box(project.labels.get(uid).label.box, box_at())
    project.frames.finalise(frame, by_hand(1))
    with pytest.raises(FinalisedFrameError):
        project.log.append(frame, [TracksLinked(labels=(LinkedLabel(uid=uid, track_id=1),))], by_machine(2))
    # linking is automatic and cannot be undone
    assert project.history.next("ann")[0] == "finalise frame 2"


def test_a_proposal_does_not_get_the_track_of_a_reviewed_box_in_its_frame(project: Project, frame: int) -> None:
    (right, wrong) = project.proposals.replace(
        frame, [proposal_at(), proposal_at(3.0)], by_machine(), track_ids=[4, 5]
    ).uids
    assert right is not None and wrong is not None
    project.labels.accept(frame, right, by_hand(1))
    project.labels.reject(frame, wrong, by_hand(2))
    found = [proposal_at(6.0), proposal_at(9.0)]
    again = project.proposals.replace(frame, found, by_machine(3), track_ids=[4, 5]).uids
    assert [_track(project, uid) for uid in again if uid] == [(None, False), (5, True)]


def test_an_old_proposal_event_without_a_track_is_read() -> None:
    new = ProposedObject(uid="u", proposal=ProposalRecord.of(proposal_at()))
    old = new.model_dump(mode="json", exclude={"track_id"})
    assert ProposedObject.model_validate_json(new.model_dump_json(exclude={"track_id"})) == new
    assert "track_id" not in old


def _span(project: Project, recording: StoredRecording, uids: list[str]) -> list[FramePart]:
    """New proposals in frames 1 to 3; the one in frame 1 replaces an open one."""
    parts = []
    for frame in project.frames.of([recording.id])[1:4]:
        open_ones = [LabelDeleted(uid=label.uid) for label in project.labels.of_frame(frame.id)]
        proposal = ProposalRecord.of(proposal_at(0.5))
        new = LabelProposed(uid=uids[len(parts)], label="hand", box=proposal.box, track_id=7, proposal=proposal)
        effort = Effort(1, 2.0) if not parts else None
        change = by_hand(frame.revision)
        parts.append(FramePart(frame.id, [*open_ones, new], type(change)(frame.revision, "ann", effort=effort)))
    return parts


def test_an_action_over_several_frames_is_undone_and_redone_as_one(
    project: Project, recording: StoredRecording
) -> None:
    frames = [frame.id for frame in project.frames.of([recording.id])]
    (old,) = project.proposals.replace(frames[1], [proposal_at()], by_machine()).uids
    before = state_of(project)
    project.log.append_to_frames(_span(project, recording, ["a", "b", "c"]))
    stored = project.labels.get("b")
    assert (stored.label.state, stored.label.source, stored.label.score) == (ReviewState.PROPOSED, Source.AUTO, 0.75)
    assert stored.quality is not None
    assert project.history.next("ann")[0] == "propose 3 labels (frames 1 to 3)"
    after = {label.uid for frame in frames for label in project.labels.of_frame(frame)}
    assert after == {"a", "b", "c"}
    done = project.history.undo("ann")
    assert [done.frame_id, *(frame for frame, _ in done.others)] == frames[1:4]
    assert [row[:9] for row in state_of(project)["labels"]] == [row[:9] for row in before["labels"]]
    assert [label.uid for label in project.labels.of_frame(frames[1])] == [old]
    project.history.redo("ann")
    assert {label.uid for frame in frames for label in project.labels.of_frame(frame)} == after
    maintained = state_of(project)
    project.log.rebuild()
    assert state_of(project) == maintained
    # another operator has accepted one of the labels: the whole action stays
    project.labels.accept(frames[3], "c", by_hand(project.frames.get(frames[3]).revision, "bob"))
    with pytest.raises(HistoryError, match="changed by bob"):
        project.history.undo("ann")
    assert len(project.labels.of_frame(frames[2])) == 1


def test_an_action_over_several_frames_is_stored_completely_or_not_at_all(
    project: Project, recording: StoredRecording
) -> None:
    parts = _span(project, recording, ["a", "b", "c"])
    project.frames.finalise(parts[2].frame_id, by_hand())
    with pytest.raises(StaleRevisionError):
        project.log.append_to_frames(parts)
    assert all(not project.labels.of_frame(part.frame_id) for part in parts)
