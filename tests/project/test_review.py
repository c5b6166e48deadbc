"""Labels: their review, new proposals beside them, stale and automatic writes that are refused."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import Engine, event
from store_samples import box_at, by_hand, by_machine, proposal_at, revised, same_box, state_of

from annotator.project import REVIEWED, NewLabel, Origin, Project, StoredRecording, WriteContext, create_project
from annotator.project.changes import LabelChanged
from annotator.project.records import BoxRecord
from annotator.types import Box2D, BoxKind, Label, OrientedBox, ReviewState, Source, Suggestion
from annotator.types.errors import FinalisedFrameError, ProjectError, StaleRevisionError


def _only(project: Project, frame: int) -> Label:
    (label,) = project.labels.of_frame(frame)
    return label


@pytest.fixture
def uid(project: Project, frame: int) -> str:
    (uid,) = project.proposals.replace(frame, [proposal_at(0.0, score=0.6)], by_machine()).uids
    assert uid is not None
    return uid


def test_a_proposal_becomes_a_label_that_is_accepted_edited_and_rejected(
    project: Project, frame: int, uid: str
) -> None:
    label = _only(project, frame)
    assert (label.uid, label.label, label.score, label.track_id) == (uid, "hand", 0.6, None)
    assert (label.state, label.source, label.author) == (ReviewState.PROPOSED, Source.AUTO, "rcv")
    assert same_box(label.box, box_at(0.0))
    assert label.time_ns == project.log.of_frame(frame)[0].time_ns
    project.labels.reject(frame, uid, by_hand(1))
    assert _only(project, frame).state is ReviewState.REJECTED
    project.labels.accept(frame, uid, by_hand(2, "bea"))
    accepted = _only(project, frame)
    assert (accepted.state, accepted.source, accepted.author) == (ReviewState.ACCEPTED, Source.AUTO, "bea")
    assert (accepted.label, accepted.score) == ("hand", 0.6) and same_box(accepted.box, box_at(0.0))
    project.labels.edit(frame, uid, by_hand(3), label="person", box=box_at(2.0), track_id=4)
    edited = _only(project, frame)
    assert (edited.state, edited.source, edited.label) == (ReviewState.EDITED, Source.AUTO, "person")
    assert (edited.score, edited.track_id) == (0.6, 4) and same_box(edited.box, box_at(2.0))


def test_a_label_that_is_deleted_or_of_another_frame_cannot_be_changed(project: Project, frame: int, uid: str) -> None:
    with pytest.raises(ProjectError, match="is not in this frame"):
        project.labels.accept(project.frames.of()[0].id, uid, by_hand())
    project.labels.delete(frame, uid, by_hand(1))
    for again in (
        lambda: project.labels.delete(frame, uid, by_hand(2)),
        lambda: project.labels.edit(frame, uid, by_hand(2), label="hand", box=box_at()),
        lambda: project.labels.get(uid),
    ):
        with pytest.raises(ProjectError, match=uid):
            again()


def test_created_labels_keep_their_state_and_source(project: Project, frame: int) -> None:
    new = [NewLabel("hand", box_at(0.0), track_id=3), NewLabel("person", box_at(1.0), 0.5, state=ReviewState.EDITED)]
    project.labels.create(frame, new, WriteContext(0, "ann", Source.IMPORTED))
    assert [(label.source, label.state, label.score, label.track_id) for label in project.labels.of_frame(frame)] == [
        (Source.IMPORTED, ReviewState.ACCEPTED, None, 3),
        (Source.IMPORTED, ReviewState.EDITED, 0.5, None),
    ]


def test_a_stored_label_has_the_signals_of_its_proposal(project: Project, frame: int) -> None:
    proposal = proposal_at()
    unsure = replace(proposal, quality=replace(proposal.quality, expected_iou_loss=0.25))
    odd = replace(proposal, quality=replace(proposal.quality, view_disagreement=math.nan, last_change=math.inf))
    uids = project.proposals.replace(frame, [unsure, odd], by_machine()).uids
    quality = project.labels.get(uids[1]).quality
    assert quality is not None
    assert math.isnan(quality.view_disagreement)
    assert (quality.kept_share, quality.last_change) == (0.9, math.inf)
    # the doubt about a box is gone with the box
    for expected in (0.25, None):
        stored = project.labels.get(uids[0])
        assert (stored.quality, stored.label.expected_iou_loss) == (unsure.quality, expected)
        project.labels.edit(frame, uids[0], revised(project, frame), label="hand", box=box_at(2.0))


def test_a_suggestion_counts_as_corrected_once_the_box_changes(project: Project, frame: int) -> None:
    given = Suggestion("base detector", "f00d")
    new = NewLabel("hand", box_at(0.0), origin=Origin.DRAWN, suggestion=given)
    (uid,) = project.labels.create(frame, [new], by_hand()).uids
    project.labels.edit(frame, uid, by_hand(1), label="person", box=box_at(0.0))
    assert project.labels.get(uid).label.suggestion == given, "only the class is another"
    present = project.labels.get(uid).label.box
    rounded = OrientedBox.from_parts(present.center_m + 1e-9, present.rotation, present.size_m - 1e-9)
    project.labels.edit(frame, uid, by_hand(2), label="hand", box=rounded)
    assert project.labels.get(uid).label.suggestion == given, "the box is the same, but for its last digits"
    np.testing.assert_array_equal(project.labels.get(uid).label.box.center_m, present.center_m)
    project.labels.edit(frame, uid, by_hand(3), label="person", box=box_at(2.0))
    project.labels.accept(frame, uid, by_hand(4))
    assert project.labels.get(uid).label.suggestion == replace(given, corrected=True)
    counts = project.statistics().suggested
    assert {name: (each.as_suggested, each.corrected) for name, each in counts.items()} == {"base detector": (0, 1)}
    for _ in range(2):
        project.history.undo(by_hand().author)
    assert project.labels.get(uid).label.suggestion == given
    redrawn = LabelChanged(
        state=ReviewState.EDITED,
        uid=uid,
        label="hand",
        box=BoxRecord.of(box_at(3.0)),
        suggestion=replace(given, detector="own"),
    )
    project.log.append(frame, [redrawn], revised(project, frame))
    counts = project.statistics().suggested
    assert {name: (each.as_suggested, each.corrected) for name, each in counts.items()} == {"own": (1, 0)}
    project.labels.reject(frame, uid, revised(project, frame))
    assert project.statistics().suggested == {}, "a rejected object is not counted"


def test_labels_are_selected_by_state_class_and_recording(
    project: Project, recording: StoredRecording, tmp_path
) -> None:
    other = project.recordings.add(tmp_path / "b", "rgbd", "b", ["x"], True)
    frames = [entry.id for entry in project.frames.of()]
    for number, id in enumerate(frames):
        found = [proposal_at(n, "hand" if n else "person") for n in (0, 9)]
        uids = project.proposals.replace(id, found, by_machine()).uids
        if number % 2 == 0:
            project.labels.accept(id, uids[0], by_hand(1))
    select = project.labels.select
    assert [entry.frame_id for entry in select()] == sorted(frames * 2)
    assert [entry.label.label for entry in select(states=REVIEWED)] == ["person"] * 3
    assert project.labels.frames(states=REVIEWED) == set(frames[::2])
    assert len(select(recordings=[other.id])) == 2
    assert len(select(classes=["hand"], states=[ReviewState.PROPOSED])) == 6
    assert select(states=[]) == ()


def test_a_label_says_what_its_box_encloses_until_it_is_changed(project: Project, frame: int) -> None:
    seen = NewLabel("hand", box_at(1.0), origin=Origin.DRAWN, box_kind=BoxKind.SILHOUETTE)
    (uid,) = project.labels.create(frame, [seen], by_hand()).uids
    kinds = []
    for revision, kind in ((1, None), (2, BoxKind.BOX)):
        kinds.append(project.labels.get(uid).label.box_kind)
        payload = LabelChanged(
            state=ReviewState.EDITED, uid=uid, label="hand", box=BoxRecord.of(box_at(2.0)), box_kind=kind
        )
        project.log.append(frame, [payload], by_hand(revision))
    kinds.append(project.labels.get(uid).label.box_kind)
    assert kinds == [BoxKind.SILHOUETTE, BoxKind.SILHOUETTE, BoxKind.BOX]


def test_new_proposals_replace_only_unreviewed_labels(project: Project, frame: int) -> None:
    first = project.proposals.replace(frame, [proposal_at(x) for x in (0.0, 5.0, 10.0, 15.0)], by_machine()).uids
    project.labels.accept(frame, first[0], by_hand(1))
    project.labels.edit(frame, first[1], by_hand(2), label="hand", box=box_at(6.0))
    project.labels.reject(frame, first[2], by_hand(3))
    second = project.proposals.replace(frame, [proposal_at(30.0)], by_machine(4))
    assert second.covered == 0
    assert [(label.uid, label.state) for label in project.labels.of_frame(frame)] == [
        (first[0], ReviewState.ACCEPTED),
        (first[1], ReviewState.EDITED),
        (first[2], ReviewState.REJECTED),
        (second.uids[0], ReviewState.PROPOSED),
    ]
    # a deleted one may be proposed again, and no proposal stays that is not found again
    project.labels.delete(frame, first[0], by_hand(5))
    assert project.proposals.replace(frame, [proposal_at(0.0)], by_machine(6)).covered == 0
    assert project.proposals.replace(frame, [], by_machine(7)).uids == ()
    assert len(project.labels.of_frame(frame)) == 2


def test_reviewed_objects_are_not_proposed_again(project: Project, frame: int) -> None:
    states = (ReviewState.ACCEPTED, ReviewState.EDITED, ReviewState.REJECTED)
    made = [NewLabel("hand", box_at(5.0 * n), state=state) for n, state in enumerate(states)]
    uids = project.labels.create(frame, made, by_hand()).uids
    found = [proposal_at(x) for x in (0.01, 5.01, 10.01, 3.0)]
    replaced = project.proposals.replace(frame, found, by_machine(3))
    assert (replaced.covered, replaced.uids[:3]) == (3, (None,) * 3)
    assert [label.uid for label in project.labels.of_frame(frame)] == [*uids, replaced.uids[3]]


@pytest.mark.parametrize(("length_m", "covered"), [(0.51, 1), (0.49, 0), (1.96, 1), (2.04, 0)])
def test_objects_with_an_iou_above_one_half_are_covered(
    project: Project, frame: int, length_m: float, covered: int
) -> None:
    # for boxes that differ only in length, the IoU is the ratio of the lengths
    project.labels.create(frame, [NewLabel("hand", box_at(0.0, 1.0))], by_hand())
    assert project.proposals.replace(frame, [proposal_at(0.0, size_m=length_m)], by_machine(1)).covered == covered


def test_only_labels_of_the_same_class_cover_a_proposal(project: Project, frame: int) -> None:
    new = [NewLabel("person", box_at(0.0)), NewLabel("hand", box_at(5.0)), NewLabel("hand", box_at(5.1))]
    project.labels.create(frame, new, by_hand())
    again = [
        proposal_at(0.0, "hand"),
        proposal_at(5.0, "person"),
        proposal_at(0.0, "person"),
        proposal_at(5.09, "hand"),
    ]
    made = project.proposals.replace(frame, again, by_machine(3)).uids
    assert [uid is None for uid in made] == [False, False, True, True]


@pytest.mark.parametrize("kind", BoxKind)
def test_proposals_are_of_the_kind_that_their_detector_measures(project: Project, frame: int, kind: BoxKind) -> None:
    project.proposals.replace(frame, [proposal_at(0.0)], by_machine(), box_kind=kind)
    requested = NewLabel("hand", box_at(5.0), state=ReviewState.PROPOSED, box_kind=kind, uid="ab")
    project.log.append(frame, [requested], by_hand(1))
    project.log.rebuild()
    assert [label.box_kind for label in project.labels.of_frame(frame)] == [kind, kind]


def test_what_a_pass_has_found_is_read_back(project: Project, frame: int) -> None:
    assert project.proposals.latest(frame) is None
    project.labels.create(frame, [NewLabel("hand", box_at(9.0))], by_hand())
    proposals = [proposal_at(0.0, score=0.5), proposal_at(9.0)]
    project.proposals.replace(frame, proposals, by_machine(1))
    latest = project.proposals.latest(frame)
    assert latest is not None
    for (label, box, score), proposal in zip(latest, proposals, strict=True):
        assert (label, score) == (proposal.label, proposal.score)
        assert same_box(box, proposal.box)


def test_a_score_that_is_no_number_is_refused(project: Project, frame: int) -> None:
    with pytest.raises(ProjectError, match="a score must be a finite number, not nan"):
        project.proposals.replace(frame, [proposal_at(score=math.nan)], by_machine())
    assert project.log.of_frame(frame) == ()


HAND = Box2D("hand", 1.0, 2.0, 3.0, 4.0)


@pytest.mark.parametrize("change", [by_hand, by_machine])
def test_a_stale_write_is_refused_with_both_revisions(project: Project, frame: int, change) -> None:
    for other in project.frames.of():
        project.boxes.set_on_image(other.id, [HAND], BoxKind.BOX, by_hand())
    with pytest.raises(StaleRevisionError, match="frame 2 of recording take is at revision 1") as caught:
        project.proposals.replace(frame, [proposal_at()], change(2))
    assert (caught.value.expected, caught.value.actual) == (2, 1)
    project.proposals.replace(frame, [proposal_at()], change(1))


def test_a_snapshot_does_not_see_what_is_written_meanwhile(project: Project, frame: int) -> None:
    with project.store.snapshot():
        assert project.frames.get(frame).revision == 0
        project.labels.create(frame, [NewLabel("hand", box_at(0))], by_hand())
        assert (project.frames.get(frame).revision, project.labels.of_frame(frame)) == (0, ())
        # a change that is based on it is refused, as any other
        with pytest.raises(StaleRevisionError):
            project.labels.create(frame, [NewLabel("hand", box_at(1))], by_hand())
    assert project.frames.get(frame).revision == len(project.labels.of_frame(frame)) == 1


def test_a_finalised_frame_refuses_automatic_writes(project: Project, frame: int) -> None:
    project.frames.finalise(frame, by_hand())
    before = state_of(project)
    for revision in (0, 1):
        for refused in (
            lambda change: project.proposals.replace(frame, [proposal_at()], change),
            lambda change: project.boxes.set_on_image(frame, [HAND], BoxKind.BOX, change),
            lambda change: project.frames.reopen(frame, change),
        ):
            with pytest.raises(FinalisedFrameError, match="frame 2 of recording take is finalised"):
                refused(by_machine(revision))
    assert state_of(project) == before


def test_an_operator_may_change_and_reopen_a_finalised_frame_once(project: Project, frame: int) -> None:
    with pytest.raises(ProjectError, match="frame 2 of recording take: the frame is not finalised"):
        project.frames.reopen(frame, by_hand())
    project.frames.finalise(frame, by_hand())
    project.boxes.set_on_image(frame, [HAND], BoxKind.BOX, by_hand(1))
    with pytest.raises(ProjectError, match="already finalised"):
        project.frames.finalise(frame, by_hand(2))
    project.frames.reopen(frame, by_hand(2))
    project.proposals.replace(frame, [proposal_at()], by_machine(3))
    assert len(project.labels.of_frame(frame)) == 1


def test_an_unknown_class_is_refused(project: Project, frame: int) -> None:
    stray = Box2D("hnad", 0.0, 0.0, 1.0, 1.0)
    for refused in (
        lambda: project.boxes.set_on_image(frame, [HAND, stray], BoxKind.BOX, by_hand()),
        lambda: project.labels.create(frame, [NewLabel("hnad", box_at())], by_hand()),
        lambda: project.proposals.replace(frame, [proposal_at(label="hnad")], by_machine()),
    ):
        with pytest.raises(ProjectError, match=r"'hnad' is not a class of the project; did you mean 'hand'\?"):
            refused()
    assert project.frames.get(frame).revision == 0


def test_every_event_has_author_time_and_source(project: Project, frame: int) -> None:
    project.boxes.set_on_image(frame, [HAND], BoxKind.BOX, WriteContext(0, "importer", Source.IMPORTED))
    (event,) = project.log.of_frame(frame)
    assert (event.author, event.source) == ("importer", Source.IMPORTED)
    assert event.time_ns > 1_700_000_000 * 10**9
    with pytest.raises(ProjectError, match="needs an author"):
        WriteContext(1, "  ")


@contextmanager
def counted() -> Iterator[list[str]]:
    """Collects the SQL statements within the block."""
    executed: list[str] = []

    def record(connection, cursor, statement, parameters, context, many) -> None:
        executed.append(statement)

    event.listen(Engine, "before_cursor_execute", record)
    try:
        yield executed
    finally:
        event.remove(Engine, "before_cursor_execute", record)


def test_a_longer_recording_needs_no_more_statements(tmp_path: Path) -> None:
    counts = []
    for frames in (20, 2_000):
        with create_project(tmp_path, f"long{frames}", ("hand",)) as project, counted() as executed:
            project.recordings.add(tmp_path / "r", "rgbd", "long", [f"{n:06d}" for n in range(frames)], True)
            run = project.jobs.start(image_detector="a", view_detector="b", config_json="{}")
            assert len(project.jobs.pending(run.key)) == frames
            _ = project.statistics(), project.frames.of(), project.labels.select()
            counts.append(len(executed))
    assert counts[0] == counts[1] < 100
