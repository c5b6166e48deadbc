"""The statistics of a project."""

from __future__ import annotations

import json

import numpy as np
from store_samples import box_at, by_hand, by_machine, proposal_at

from annotator.project import NewLabel, Project, RunShare, StoredRecording, WriteContext
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, AttributeKind, AttributeOf
from annotator.project.progress.action_log import ORIGINS
from annotator.types import Box2D, BoxKind, Source

NO_EFFORT = {"boxes": 0, "seconds_a_box": None, "actions_a_box": None}


def test_an_empty_project_has_zero_counts(project: Project) -> None:
    numbers = json.loads(project.statistics().model_dump_json())
    assert numbers["recordings"] == numbers["frames"] == numbers["events"] == 0
    assert numbers["labels"] == {
        "total": 0,
        "by_state": {"proposed": 0, "accepted": 0, "edited": 0, "rejected": 0},
        "by_class": {},
        "by_class_and_state": {},
        "by_source": {"manual": 0, "auto": 0, "imported": 0},
        "by_kind": {"box": 0, "silhouette": 0},
    }
    assert numbers["image_boxes"] == {
        "pictures": 0,
        "boxes": 0,
        "boxes_by_source": {"manual": 0, "auto": 0, "imported": 0},
    }


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
        "events": 7,
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
        project.change_classes(lambda config, each=attribute: edit.put_attribute(config, each), "ann")
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
