"""The effort per box by origin, and the results of reviewing proposals."""

from __future__ import annotations

import pytest
from store_samples import box_at, by_machine, proposal_at

from annotator.geometry.iou import iou_3d
from annotator.project import Effort, NewLabel, Origin, Project, WriteContext
from annotator.project.log.event_types import LabelAccepted, LabelCreated
from annotator.project.log.records import BoxRecord
from annotator.project.progress.action_log import draft_id
from annotator.types import Box2D, BoxKind, Source


def ann(revision: int, actions: int | None = None, seconds: float = 0.0, target: str | None = None) -> WriteContext:
    effort = None if actions is None else Effort(actions, seconds)
    return WriteContext(revision, "ann", effort=effort, effort_target=target)


def test_without_boxes_effort_is_undefined(project: Project, frame: int) -> None:
    numbers = project.statistics()
    assert (numbers.effort.boxes, numbers.effort.seconds_a_box, numbers.effort.actions_a_box) == (0, None, None)
    assert numbers.accepted_untouched is None
    assert numbers.iou_proposal_to_final is None
    assert all(part.boxes == 0 for part in numbers.effort.by_origin.values())


def test_effort_of_accepted_edited_and_rejected_proposals_is_counted(project: Project, frame: int) -> None:
    uids = project.proposals.replace(frame, [proposal_at(5.0 * n) for n in range(4)], by_machine()).uids
    assert None not in uids
    project.labels.accept(frame, uids[0] or "", ann(1, 1, 2.0))
    project.labels.edit(frame, uids[1] or "", ann(2, 3, 8.0), label="hand", box=box_at(5.2))
    project.labels.accept(frame, uids[1] or "", ann(3, 1, 1.0))
    project.labels.reject(frame, uids[2] or "", ann(4, 1, 1.0))
    numbers = project.statistics()
    parts = numbers.effort.by_origin
    assert (parts["proposal accepted untouched"].boxes, parts["proposal accepted untouched"].actions_a_box) == (1, 1)
    edited = parts["proposal edited"]
    assert (edited.boxes, edited.actions_a_box, edited.seconds_a_box) == (1, 4.0, 9.0)
    assert (numbers.effort.boxes, numbers.effort.actions_a_box, numbers.effort.seconds_a_box) == (2, 2.5, 5.5)
    assert numbers.accepted_untouched == pytest.approx(1 / 3), "one of three reviewed proposals"
    assert numbers.iou_proposal_to_final == pytest.approx((1 + iou_3d(box_at(5.0), box_at(5.2))) / 2)
    assert numbers.labels.by_class_and_state["hand"] == {"proposed": 1, "accepted": 2, "edited": 0, "rejected": 1}


def test_an_undone_edit_leaves_the_proposal_untouched(project: Project, frame: int) -> None:
    uid = project.proposals.replace(frame, [proposal_at(0.0)], by_machine()).uids[0] or ""
    project.labels.edit(frame, uid, ann(1, 2, 2.0), label="hand", box=box_at(9.0))
    project.history.undo("ann", effort=Effort(1, 0.5))
    project.labels.accept(frame, uid, ann(3, 1, 1.0))
    numbers = project.statistics()
    assert numbers.accepted_untouched == 1.0
    assert numbers.iou_proposal_to_final == pytest.approx(1.0)
    assert numbers.effort.actions_a_box == 4.0, "the undone edit counts"


def test_an_action_for_several_labels_is_divided_among_them(project: Project, frame: int) -> None:
    uids = project.proposals.replace(frame, [proposal_at(0.0), proposal_at(5.0)], by_machine()).uids
    project.log.append(frame, [LabelAccepted(uid=uid or "") for uid in uids], ann(1, 1, 3.0))
    numbers = project.statistics()
    assert (numbers.effort.boxes, numbers.effort.actions_a_box, numbers.effort.seconds_a_box) == (2, 0.5, 1.5)


def test_effort_with_a_target_counts_for_that_label(project: Project, frame: int) -> None:
    uids = project.labels.create(frame, [NewLabel("hand", box_at()), NewLabel("hand", box_at(5.0))], ann(0)).uids
    project.boxes.set_on_image(frame, [], BoxKind.BOX, ann(2, 4, 4.0, uids[1]))
    assert (project.statistics().effort.boxes, project.statistics().effort.actions_a_box) == (1, 4.0)


def test_effort_for_a_draft_counts_for_its_label(project: Project, frame: int) -> None:
    first, moved = Box2D("hand", 1.0, 1.0, 9.0, 9.0), Box2D("hand", 2.0, 1.0, 9.0, 9.0)
    other = Box2D("hand", 50.0, 1.0, 60.0, 9.0)
    project.boxes.set_on_image(frame, [other], BoxKind.BOX, ann(0, 7, 7.0, draft_id(frame, other)))
    project.boxes.set_on_image(frame, [other, first], BoxKind.BOX, ann(1, 1, 2.0, draft_id(frame, first)))
    project.boxes.set_on_image(frame, [other, moved], BoxKind.BOX, ann(2, 1, 2.0, draft_id(frame, moved)))
    made = LabelCreated(uid="u", label="hand", box=BoxRecord.of(box_at()), origin=Origin.DRAWN, image_box=moved)
    project.log.append(frame, [made], ann(3, 1, 3.0, draft_id(frame, moved)))
    project.labels.edit(frame, "u", ann(4, 2, 1.0, "u"), label="hand", box=box_at(0.1))
    numbers = project.statistics().effort
    assert (numbers.boxes, numbers.actions_a_box, numbers.seconds_a_box) == (1, 5.0, 8.0)
    assert numbers.by_origin["from nothing"].boxes == 1


def test_effort_is_counted_by_origin(project: Project, frame: int) -> None:
    box = BoxRecord.of(box_at())
    made = [
        LabelCreated(uid=str(n), label="hand", box=box, origin=origin)
        for n, origin in enumerate((Origin.DRAWN, Origin.PLACED, Origin.COPIED))
    ]
    project.log.append(frame, made, ann(0, 6, 6.0))
    imported = project.labels.create(
        frame, [NewLabel("hand", box_at())] * 2, WriteContext(3, "import", Source.IMPORTED)
    ).uids
    project.labels.edit(frame, imported[0], ann(5, 1, 1.0), label="hand", box=box_at(1.0))
    parts = project.statistics().effort.by_origin
    assert {name for name, part in parts.items() if part.boxes} == {
        "from nothing",
        "placed in 3D",
        "copied",
        "import edited",
    }
    assert project.statistics().effort.boxes == 4, "an imported box without an edit has no effort"
