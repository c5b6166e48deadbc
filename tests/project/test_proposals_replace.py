"""New proposals of a frame: which labels they replace, which stay, and which objects are not proposed again."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from store_samples import box_at, by_hand, by_machine, lost_object, proposal_at, same_box

from annotator.project import NewLabel, Project, RunShare
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


@pytest.mark.parametrize("state", [ReviewState.ACCEPTED, ReviewState.EDITED, ReviewState.REJECTED])
def test_reviewed_objects_are_not_proposed_again(project: Project, frame: int, state: ReviewState) -> None:
    created = project.labels.create(frame, [NewLabel("hand", box_at(0.0), state=state)], by_hand())
    replaced = project.proposals.replace(frame, [proposal_at(0.01), proposal_at(3.0)], by_machine(1))
    assert (replaced.covered, replaced.uids[0]) == (1, None)
    assert [label.uid for label in project.labels.of_frame(frame)] == [created.uids[0], replaced.uids[1]]


@pytest.mark.parametrize(("length_m", "covered"), [(0.51, 1), (0.49, 0), (1.96, 1), (2.04, 0)])
def test_objects_with_an_iou_above_one_half_are_covered(
    project: Project, frame: int, length_m: float, covered: int
) -> None:
    # for boxes that differ only in length, the IoU is the ratio of the lengths
    project.labels.create(frame, [NewLabel("hand", box_at(0.0, 1.0))], by_hand())
    assert project.proposals.replace(frame, [proposal_at(0.0, size_m=length_m)], by_machine(1)).covered == covered


def test_only_labels_of_the_same_class_cover_a_proposal(project: Project, frame: int) -> None:
    new = [NewLabel("person", box_at(0.0)), NewLabel("hand", box_at(5.0)), NewLabel("hand", box_at(5.1))]
    uids = project.labels.create(frame, new, by_hand()).uids
    again = [
        proposal_at(0.0, "hand"),
        proposal_at(5.0, "person"),
        proposal_at(0.0, "person"),
        proposal_at(5.09, "hand"),
    ]
    project.proposals.replace(frame, again, by_machine(3))
    latest = project.proposals.latest(frame)
    assert latest is not None
    assert [entry.covered_by for entry in latest.objects] == [None, None, uids[0], uids[2]]


@pytest.mark.parametrize("kind", BoxKind)
def test_proposals_are_of_the_kind_that_their_detector_measures(project: Project, frame: int, kind: BoxKind) -> None:
    project.proposals.replace(frame, [proposal_at(0.0)], by_machine(), box_kind=kind)
    requested = NewLabel("hand", box_at(5.0), state=ReviewState.PROPOSED, box_kind=kind, uid="ab")
    project.log.append(frame, [requested], by_hand(1))
    project.log.rebuild()
    assert [label.box_kind for label in project.labels.of_frame(frame)] == [kind, kind]


def test_the_trace_is_read_back(project: Project, frame: int) -> None:
    assert project.proposals.latest(frame) is None
    proposals = [proposal_at(0.0, steps=3, views=4), proposal_at(9.0, steps=1)]
    object.__setattr__(proposals[0].trace[0], "points_in", np.int64(3))
    run = project.jobs.start(image_detector="a", view_detector="b", config_json="{}")
    share = RunShare(run.id, 0.5)
    uids = project.proposals.replace(frame, proposals, by_machine(), lost=[lost_object()], run=share).uids
    project.labels.edit(frame, uids[0], by_hand(1), label="person", box=box_at(4.0))
    latest = project.proposals.latest(frame)
    assert latest is not None
    for back, proposal in zip([entry.proposal.proposal() for entry in latest.objects], proposals, strict=True):
        for field in ("label", "score", "image_box", "quality", "trace"):
            assert getattr(back, field) == getattr(proposal, field)
        assert same_box(back.box, proposal.box)
    assert type(latest.objects[0].proposal.trace[0].points_in) is int
    assert latest.run == run.id
    assert [entry.uid for entry in latest.objects] == list(uids)
    assert [dataclasses.astuple(lost) for lost in latest.lost] == [dataclasses.astuple(lost_object())]


@pytest.mark.parametrize(
    ("field", "value"), [("score", math.nan), ("score", "high"), ("trace", ("not a step",)), ("image_box", np.zeros(4))]
)
def test_values_that_cannot_be_stored_are_refused(project: Project, frame: int, field: str, value: object) -> None:
    bad = proposal_at()
    object.__setattr__(bad, field, value)  # bypasses the check of the frozen dataclass
    with pytest.raises(ProjectError, match=r"frame 2 of recording take: .*cannot be stored"):
        project.proposals.replace(frame, [bad], by_machine())
    assert project.log.of_frame(frame) == ()
