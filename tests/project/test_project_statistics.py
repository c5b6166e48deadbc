"""The statistics of a project."""

from __future__ import annotations

import json

import numpy as np
import pytest
from store_samples import box_at, by_hand, by_machine, proposal_at

from annotator.geometry.iou import iou_3d
from annotator.project import Effort, NewLabel, Origin, Project, RunShare, StoredRecording, WriteContext
from annotator.project.changes import LabelChanged
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, AttributeKind, AttributeOf
from annotator.project.progress.reviewed import ORIGINS, draft_id
from annotator.types import Box2D, BoxKind, ReviewState, Source


def ann(revision: int, actions: int | None = None, seconds: float = 0.0, target: str | None = None) -> WriteContext:
    effort = None if actions is None else Effort(actions, seconds)
    return WriteContext(revision, "ann", effort=effort, effort_target=target)


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
    project.log.append(frame, [LabelChanged(uid=uid or "", state=ReviewState.ACCEPTED) for uid in uids], ann(1, 1, 3.0))
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
    made = NewLabel("hand", box_at(), origin=Origin.DRAWN, image_box=moved, uid="u")
    project.log.append(frame, [made], ann(3, 1, 3.0, draft_id(frame, moved)))
    project.labels.edit(frame, "u", ann(4, 2, 1.0, "u"), label="hand", box=box_at(0.1))
    numbers = project.statistics().effort
    assert (numbers.boxes, numbers.actions_a_box, numbers.seconds_a_box) == (1, 5.0, 8.0)
    assert numbers.by_origin["from nothing"].boxes == 1


def test_effort_is_counted_by_origin(project: Project, frame: int) -> None:
    made = [
        NewLabel("hand", box_at(), origin=origin, uid=str(n))
        for n, origin in enumerate((Origin.DRAWN, Origin.PLACED, Origin.COPIED))
    ]
    project.log.append(frame, made, ann(0, 6, 6.0))
    imported = project.labels.create(
        frame, [NewLabel("hand", box_at()) for _ in range(2)], WriteContext(3, "import", Source.IMPORTED)
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


NO_EFFORT = {"boxes": 0, "seconds_a_box": None, "actions_a_box": None}


def test_labels_boxes_and_events_are_counted(project: Project, recording: StoredRecording) -> None:
    frames = [frame.id for frame in project.frames.of()]
    run = project.jobs.start(image_detector="a", view_detector="b", config_json="{}")
    uids = project.proposals.replace(
        frames[0], [proposal_at(0.0), proposal_at(5.0)], by_machine(), run=RunShare(run.id, 1.0)
    ).uids
    project.labels.accept(frames[0], uids[0], by_hand(1))
    project.jobs.record_failure(run.id, frames[1], "broken", 0.1)
    project.labels.create(frames[2], [NewLabel("person", box_at())], WriteContext(0, "file", Source.IMPORTED))
    project.frames.finalise(frames[2], by_hand(1))
    boxes = [Box2D("hand", 0.0, 0.0, 1.0, 1.0)] * 2
    project.boxes.set_on_image(frames[3], boxes, BoxKind.BOX, by_hand())
    project.boxes.set_on_image(frames[4], [], BoxKind.BOX, WriteContext(0, "file", Source.IMPORTED))
    view = project.views.store(np.zeros((4, 4, 3), np.uint8))
    project.boxes.set_on_view(view, boxes + boxes[:1], BoxKind.BOX, WriteContext(0, "file", Source.IMPORTED))

    numbers = json.loads(project.statistics().model_dump_json())
    assert numbers.pop("progress")["forecast"]["frames_left"] == 3
    assert numbers == {
        "recordings": 1,
        "frames": 5,
        "frames_finalised": 1,
        "frames_with_labels": 2,
        "frames_with_proposals": 1,
        "frames_failed": 1,
        "labels": {
            "total": 3,
            "by_state": {"proposed": 1, "accepted": 2, "edited": 0, "rejected": 0},
            "by_class": {"hand": 2, "person": 1},
            "by_class_and_state": {
                "hand": {"proposed": 1, "accepted": 1, "edited": 0, "rejected": 0},
                "person": {"proposed": 0, "accepted": 1, "edited": 0, "rejected": 0},
            },
            "by_source": {"manual": 0, "auto": 2, "imported": 1},
            "by_kind": {"box": 3, "silhouette": 0},
        },
        "suggested": {},
        "attributes": {},
        "without_value": {},
        "image_boxes": {"pictures": 2, "boxes": 2, "boxes_by_source": {"manual": 2, "auto": 0, "imported": 0}},
        "view_boxes": {"pictures": 1, "boxes": 3, "boxes_by_source": {"manual": 0, "auto": 0, "imported": 3}},
        "events": 8,
        "runs": 1,
        "models": 0,
        "effort": {**NO_EFFORT, "by_origin": dict.fromkeys(ORIGINS, NO_EFFORT)},
        "accepted_untouched": 1.0,
        "iou_proposal_to_final": 1.0,
    }


def test_values_are_counted_with_the_defaults_of_frames(project: Project, recording: StoredRecording) -> None:
    pose = Attribute(name="pose", kind=AttributeKind.CHOICE, choices=("sitting", "standing"), classes=("person",))
    rain = Attribute(name="rain", kind=AttributeKind.BOOLEAN, of=AttributeOf.FRAME, default=False)
    place = Attribute(name="place", kind=AttributeKind.TEXT, of=AttributeOf.FRAME)
    for attribute in (pose, rain, place):
        project.change_classes(edit.PutAttribute(attribute=attribute), "ann")
    empty = project.statistics()
    assert empty.attributes == {"pose": {}, "rain": {"false": 5}, "place": {}}
    assert empty.without_value == {"pose": 0, "rain": 0, "place": 5}
    first, second, third = [frame.id for frame in project.frames.of()][:3]
    people = [NewLabel("person", box_at(x)) for x in (0.0, 5.0, 10.0)]
    uids = project.labels.create(first, [*people, NewLabel("hand", box_at(20.0))], by_hand()).uids
    project.labels.set_attributes(first, uids[0], {"pose": "sitting"}, by_hand(4))
    project.labels.reject(first, uids[1], by_hand(5))
    project.frames.set_attributes(second, {"rain": True, "place": "yard"}, by_hand())
    project.frames.set_attributes(third, {"rain": False}, by_hand())
    counts = project.statistics()
    assert counts.attributes == {"pose": {"sitting": 1}, "rain": {"false": 4, "true": 1}, "place": {"yard": 1}}
    assert counts.without_value == {"pose": 1, "rain": 0, "place": 4}
    # a frame that its recording no longer has keeps its value, and has no default
    project.recordings.rescan(recording.id, [frame.key for frame in project.frames.of()][2:])
    assert project.statistics().attributes["rain"] == {"false": 3, "true": 1}
    assert project.value_counts()["rain"] == {"false": 1, "true": 1}, "only stored values are removed with an attribute"
