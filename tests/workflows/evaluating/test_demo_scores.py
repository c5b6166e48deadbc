"""Scores of a project against its recordings' truth, checked with modified labels."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from annotator.geometry.oriented_box import contains
from annotator.project import NewLabel, Project, WriteContext
from annotator.recordings import open_recording
from annotator.types import OrientedBox, ReviewState
from annotator.workflows.evaluate import score_project
from annotator.workflows.recorded.reading import load_truth


def put(project: Project, index: int, change: Callable[[int, OrientedBox], OrientedBox | None], **more: object) -> None:
    """Labels a frame with its true boxes, modified by `change`."""
    recording = open_recording(project.recordings.all()[0].path)
    stored = project.frames.of()[index]
    truths = load_truth(recording, index, recording.frame(index))
    boxes = [(t.label, change(number, t.box)) for number, t in enumerate(truths)]
    new = [NewLabel(label, box, **more) for label, box in boxes if box is not None]
    project.labels.create(stored.id, new, WriteContext(stored.revision, "me"))


def moved(box: OrientedBox, share: float) -> OrientedBox:
    """The box shifted along its x axis by a fraction of its length: IoU (1 - share) / (1 + share)."""
    shift = box.rotation @ (np.array([share, 0, 0]) * box.size_m)
    return OrientedBox.from_parts(box.center_m + shift, box.rotation, box.size_m)


def score(project: Project, **options: object):
    (scores,) = score_project(project, project.recordings.all()[0].id, **options)
    return scores


def test_true_boxes_have_scores_of_1(people: Project) -> None:
    put(people, 0, lambda _, box: box, state=ReviewState.REJECTED)
    scores = score(people)
    assert (scores.found, scores.mean_iou, scores.ap25, scores.ap50) == (0.0, 0.0, 0.0, 0.0), "nothing counts yet"
    for index in range(5):
        put(people, index, lambda _, box: box)
    scores = score(people)
    assert (scores.label, scores.frames, scores.objects) == ("person", 5, 15)
    assert (scores.found, scores.ap25, scores.ap50) == (1.0, 1.0, 1.0)
    assert scores.mean_iou == pytest.approx(1.0)


def test_shifted_and_missing_boxes_reduce_the_scores(people: Project) -> None:
    """First box exact, second at IoU 1/3, third missing; only frame 0."""
    put(people, 0, lambda number, box: [box, moved(box, 0.5), None][number])
    scores = score(people, frame_ids=[people.frames.of()[0].id])
    assert (scores.frames, scores.objects) == (1, 3)
    assert scores.found == pytest.approx(2 / 3)
    assert scores.mean_iou == pytest.approx((1 + 1 / 3 + 0) / 3, abs=1e-6)
    assert scores.ap25 == pytest.approx(2 / 3)
    assert scores.ap50 == pytest.approx(1 / 3)


def test_objects_of_few_points_are_left_out(people: Project) -> None:
    assert score(people, min_points=10**6).objects == 0
    nothing = score(people, min_points=10**6)
    assert np.isnan(nothing.mean_iou)
    assert np.isnan(nothing.ap50)
    assert score(people, min_points=0).objects == 15


def test_a_label_on_an_object_of_few_points_is_neither_tp_nor_fp(people: Project) -> None:
    recording = open_recording(people.recordings.all()[0].path)
    frame = recording.frame(0)
    points = [int(contains(t.box, frame.cloud.xyz_m).sum()) for t in load_truth(recording, 0, frame)]
    least = int(np.argmin(points))
    options = {"frame_ids": [people.frames.of()[0].id], "min_points": min(points) + 1}
    # boxes with equal scores are ranked in label order, so a false positive would have to come first
    put(people, 0, lambda number, box: box if number == least else None)
    put(people, 0, lambda number, box: None if number == least else box)
    scores = score(people, **options)
    assert (scores.objects, scores.ap50) == (2, 1.0)


def test_classes_are_scored_separately(make_project: Callable[..., Project], generated: Path) -> None:
    project = make_project(generated / "people", classes=("robot", "person"))
    put(project, 0, lambda _, box: box)
    robot, person = score_project(project, project.recordings.all()[0].id)
    assert (robot.label, robot.objects) == ("robot", 0)
    assert (person.label, person.objects) == ("person", 15)
    assert person.mean_iou == pytest.approx(1 / 5)
