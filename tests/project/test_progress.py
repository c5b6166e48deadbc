"""Statistics: counts and effort, by day and person, of the proposals, and of what is left."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from store_samples import box_at, by_hand, by_machine, proposal_at

from annotator.geometry.iou import iou_3d
from annotator.project import Effort, NewLabel, Origin, Project, RunShare, StoredRecording, WriteContext, create_project
from annotator.project.changes import LabelChanged
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, AttributeKind, AttributeOf
from annotator.project.progress.reviewed import ORIGINS, draft_id
from annotator.types import Box2D, BoxKind, ReviewState, Source

MONDAY, TUESDAY = datetime(2026, 1, 5, 12), datetime(2026, 1, 6, 12)


class Shift:
    """A project whose clock the test sets, and people who work in it."""

    def __init__(self, folder: Path, frames: int = 40) -> None:
        self.now_s = MONDAY.timestamp()
        self.project = create_project(folder, "shift", ("hand", "person"), clock=lambda: int(self.now_s * 1e9))
        keys = [f"{n:03d}" for n in range(frames)]
        self.project.recordings.add(folder / "take", "rgbd", "take", keys, True)
        self.frames = [frame.id for frame in self.project.frames.of()]

    def at(self, day: datetime, after_s: float = 0.0) -> None:
        self.now_s = day.timestamp() + after_s

    def by(self, frame: int, person: str = "ann", actions: int = 1, seconds: float = 1.0) -> WriteContext:
        return WriteContext(self.project.frames.get(frame).revision, person, effort=Effort(actions, seconds))

    def progress(self) -> dict[str, Any]:
        content: dict[str, Any] = json.loads(self.project.statistics().model_dump_json())["progress"]
        return content


@pytest.fixture
def shift(tmp_path: Path) -> Iterator[Shift]:
    shift = Shift(tmp_path)
    with shift.project:
        yield shift


def test_work_is_counted_by_day_and_person(shift: Shift) -> None:
    project, (frame, other) = shift.project, shift.frames[:2]
    uids = project.proposals.replace(frame, [proposal_at(5.0 * n) for n in range(3)], by_machine()).uids
    project.labels.accept(frame, uids[0] or "", shift.by(frame, seconds=2.0))
    shift.at(MONDAY, 60.0)
    project.labels.reject(frame, uids[1] or "", shift.by(frame, seconds=3.0))
    shift.at(MONDAY, 7200.0)
    gone = project.labels.create(other, [NewLabel("hand", box_at())], shift.by(other, actions=5, seconds=20.0)).uids
    shift.at(TUESDAY)
    project.labels.delete(other, gone[0], shift.by(other, seconds=1.0))
    project.labels.edit(frame, uids[2] or "", shift.by(frame, "bob", 4, 9.0), label="hand", box=box_at(9.9))
    # a later look at what ann has done: the box stays hers, the time is bob's
    project.labels.edit(frame, uids[0] or "", shift.by(frame, "bob", 2, 5.0), label="hand", box=box_at(0.1))
    monday, tuesday, of_bob = shift.progress()["days"]
    expected = {"day": "2026-01-05", "person": "ann", "boxes": 1, "rejected": 1, "frames": 2, "actions": 7}
    # counted: 2 s before the first action, 60 s to the next, and 20 s after the break
    assert monday == {**expected, "seconds": 25.0, "hours": pytest.approx(82 / 3600)}
    assert (tuesday["person"], tuesday["boxes"], tuesday["actions"]) == ("ann", 0, 1)
    assert (of_bob["day"], of_bob["person"], of_bob["boxes"], of_bob["seconds"]) == ("2026-01-06", "bob", 1, 14.0)


def test_commands_are_no_people(shift: Shift) -> None:
    project, frame = shift.project, shift.frames[0]

    def drawn(person: str, effort: Effort | None) -> None:
        context = WriteContext(project.frames.get(frame).revision, person, effort=effort)
        project.boxes.set_on_image(frame, [], BoxKind.BOX, context)

    drawn("simulated operator", None)
    proposed = NewLabel("hand", box_at(), state=ReviewState.PROPOSED, uid="u")
    project.log.append(frame, [proposed], WriteContext(project.frames.get(frame).revision, "annotator follow"))
    assert shift.progress()["days"] == []
    project.labels.reject(frame, "u", WriteContext(project.frames.get(frame).revision, "by script"))
    drawn("draws only on images", Effort(2, 5.0))
    assert [entry["person"] for entry in shift.progress()["days"]] == ["by script", "draws only on images"]


def test_undo_and_redo_leave_a_box_with_who_labelled_it(shift: Shift) -> None:
    project, frame = shift.project, shift.frames[0]
    uid = project.proposals.replace(frame, [proposal_at()], by_machine()).uids[0] or ""
    project.labels.accept(frame, uid, shift.by(frame))
    shift.at(TUESDAY)
    project.history.undo("ann")
    assert [entry["boxes"] for entry in shift.progress()["days"]] == [0, 0]
    project.history.redo("ann")
    assert [entry["boxes"] for entry in shift.progress()["days"]] == [1, 0]
    project.history.undo("ann")
    project.labels.accept(frame, uid, shift.by(frame, "bob"))
    assert [(entry["person"], entry["boxes"]) for entry in shift.progress()["days"][1:]] == [("ann", 0), ("bob", 1)]


def test_the_pace_follows_the_order_of_the_work(shift: Shift) -> None:
    for n, frame in enumerate(shift.frames):
        shift.at(MONDAY, 100.0 * n)
        slow = n < 20
        effort = shift.by(frame, actions=4 if slow else 2, seconds=12.0 if slow else 6.0)
        shift.project.labels.create(frame, [NewLabel("hand", box_at())], effort)
    pace = shift.progress()["pace"]
    assert [group["boxes"] for group in pace["groups"]] == [10, 10, 10, 10]
    assert [group["seconds_a_box"] for group in pace["groups"]] == [12.0, 12.0, 6.0, 6.0]
    assert (pace["earliest"]["actions_a_box"], pace["latest"]["actions_a_box"]) == (4.0, 2.0)
    assert pace["latest"]["proposed"] == 0.0
    assert pace["latest"]["iou_proposal_to_final"] is None


def test_proposals_are_compared_by_class_and_distance(shift: Shift) -> None:
    project, frame = shift.project, shift.frames[0]
    offered = [proposal_at(0.0), proposal_at(4.0), proposal_at(60.0), proposal_at(0.0, "person")]
    uids = [uid or "" for uid in project.proposals.replace(frame, offered, by_machine()).uids]
    project.labels.accept(frame, uids[0], shift.by(frame))
    project.labels.edit(frame, uids[1], shift.by(frame), label="hand", box=box_at(4.2))
    project.labels.reject(frame, uids[2], shift.by(frame))
    project.labels.edit(frame, uids[3], shift.by(frame), label="hand", box=box_at(0.0))
    project.labels.create(frame, [NewLabel("hand", box_at(60.0))], shift.by(frame))
    # neither proposed nor touched
    project.labels.create(frame, [NewLabel("person", box_at(8.0))], by_machine(project.frames.get(frame).revision))
    quality = shift.progress()["proposals"]
    moved = iou_3d(box_at(4.0), box_at(4.2))
    counts = {"untouched": 1, "corrected": 2, "rejected": 1, "missed": 1}
    hand = counts | {"iou_proposal_to_final": pytest.approx((2 + moved) / 3)}
    assert quality["by_class"]["hand"] == hand
    assert [(each["from_m"], each["missed"]) for each in quality["by_range"]] == [(3.0, 0), (5.0, 1), (50.0, 1)]
    near, middle, far = quality["by_class_and_range"]["hand"]
    assert (near["from_m"], near["to_m"], near["untouched"], near["corrected"]) == (3.0, 5.0, 1, 1)
    assert (middle["from_m"], middle["iou_proposal_to_final"]) == (5.0, pytest.approx(moved))
    assert (far["from_m"], far["to_m"], far["rejected"], far["missed"]) == (50.0, 70.0, 1, 1)
    assert far["iou_proposal_to_final"] is None


def test_a_box_that_following_proposed_is_a_proposal(shift: Shift) -> None:
    frame = shift.frames[0]
    proposed = NewLabel("hand", box_at(), state=ReviewState.PROPOSED, uid="u")
    shift.project.log.append(frame, [proposed], shift.by(frame))
    shift.project.labels.accept(frame, "u", shift.by(frame))
    assert shift.project.statistics().effort.by_origin["proposal accepted untouched"].boxes == 1
    assert shift.progress()["proposals"]["by_class"]["hand"]["missed"] == 0


def label(shift: Shift, count: int, seconds: float = 18.0) -> None:
    """Two boxes in each of `count` frames; the time at work is `seconds` per box."""
    for n, frame in enumerate(shift.frames[:count]):
        for box in range(2):
            shift.at(MONDAY, seconds * (2 * n + box + 1))
            shift.project.labels.create(
                frame, [NewLabel("hand", box_at(4.0 * box))], shift.by(frame, seconds=0.5 * seconds)
            )


def test_open_proposals_empty_frames_and_passes_that_found_nothing(shift: Shift) -> None:
    project = shift.project
    label(shift, 20)
    run = project.jobs.start(image_detector="a", view_detector="b", config_json="{}").id
    for frame in shift.frames[20:30]:
        project.proposals.replace(frame, [proposal_at(4.0 * n) for n in range(3)], by_machine(), run=RunShare(run, 0.1))
    for frame in shift.frames[30:36]:
        project.proposals.replace(frame, [], by_machine(), run=RunShare(run, 0.1))
    project.boxes.set_on_image(shift.frames[36], [], BoxKind.BOX, shift.by(shift.frames[36]))
    project.frames.finalise(shift.frames[37], shift.by(shift.frames[37]))
    forecast = shift.progress()["forecast"]
    assert (forecast["frames_done"], forecast["frames_found_empty"], forecast["frames_left"]) == (22, 6, 12)
    assert forecast["proposals_open"] == 30
    assert forecast["boxes_left"] == pytest.approx(30 + 2 * 40 / 22)


def test_few_frames_allow_no_forecast(shift: Shift) -> None:
    label(shift, 9)
    forecast = shift.progress()["forecast"]
    assert (forecast["boxes_left"], forecast["hours_left"], forecast["boxes_an_hour"]) == (None, None, None)


def test_nothing_is_left_of_a_project_that_is_done(shift: Shift) -> None:
    label(shift, 40)
    assert shift.progress()["forecast"]["hours_left"] == {"low": 0.0, "expected": 0.0, "high": 0.0}


def test_the_range_is_that_of_the_slowest_and_the_fastest_of_the_last_frames(shift: Shift) -> None:
    after_s = 0.0
    for n, frame in enumerate(shift.frames[:20]):
        after_s += 40.0 if n < 10 else 20.0
        shift.at(MONDAY, after_s)
        shift.project.labels.create(frame, [NewLabel("hand", box_at())], shift.by(frame, seconds=20.0))
    forecast = shift.progress()["forecast"]
    # nothing is known of the time before the first box but what the page has counted
    assert forecast["boxes_an_hour"] == {"low": 90.0, "expected": pytest.approx(20 * 3600 / 580), "high": 180.0}
    assert forecast["hours_left"] == {"low": 20 / 180, "expected": pytest.approx(580 / 3600), "high": 20 / 90}


def test_the_statistics_follow_frames_that_are_exchanged_for_as_many_others(tmp_path: Path) -> None:
    shift = Shift(tmp_path, frames=3)

    def frames() -> tuple[int, int]:
        forecast = shift.progress()["forecast"]
        return forecast["frames_done"], forecast["frames_left"]

    with shift.project as project:
        take, other_keys = project.recordings.all()[0], ["a", "b", "c"]
        project.labels.create(shift.frames[0], [NewLabel("hand", box_at())], shift.by(shift.frames[0]))
        other = project.recordings.add(tmp_path / "other", "rgbd", "other", other_keys, True)
        project.recordings.remove(other.id, "bea")
        assert frames() == (1, 2)
        project.recordings.rescan(other.id, other_keys)
        project.recordings.remove(take.id, "bea")
        assert frames() == (0, 3)
        project.recordings.rescan(take.id, ["000", "001", "002"])
        project.recordings.remove(other.id, "bea")
        assert frames() == (1, 2)
        project.recordings.rescan(take.id, ["001", "002", "003"])
        assert frames() == (0, 3)


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
