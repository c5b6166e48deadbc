"""The review of 3D labels."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from store_samples import box_at, by_hand, by_machine, proposal_at, revised, same_box

from annotator.project import REVIEWED, NewLabel, Origin, Project, StoredRecording, WriteContext
from annotator.project.changes import LabelChanged
from annotator.project.records import BoxRecord
from annotator.types import BoxKind, Label, OrientedBox, ReviewState, Source, Suggestion
from annotator.types.errors import ProjectError


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
