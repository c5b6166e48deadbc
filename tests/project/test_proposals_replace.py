"""New proposals of a frame: which labels they replace, which stay, and which objects are not proposed again."""

from __future__ import annotations

import math

import pytest
from store_samples import box_at, by_hand, by_machine, proposal_at, same_box

from annotator.project import NewLabel, Project
from annotator.types import BoxKind, ReviewState
from annotator.types.errors import ProjectError


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
