"""The benchmark of reviewing: the keystroke-level model, the plans of the hand, and the simulated operator."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from annotator.geometry.iou import iou_3d
from annotator.project import Project, WriteContext, create_project
from annotator.recordings import open_recording
from annotator.types import Box2D, OrientedBox, Proposal, Quality, Source, Truth
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.recorded.reading import load_truth
from benchmarks.review_moves import Bill
from benchmarks.review_operator import Operator

QUALITY = 0.7


def moved(box: OrientedBox, along: tuple[float, float, float]) -> OrientedBox:
    """A box shifted along its own axes, metres."""
    return OrientedBox.from_parts(box.center_m + box.rotation @ np.array(along), box.rotation, box.size_m)


@pytest.fixture
def people(generated: Path) -> Path:
    return generated / "people"


@pytest.fixture
def room(people: Path, tmp_path: Path) -> Project:
    """A project of the generated recording without labels."""
    project = create_project(tmp_path, "room", ["person"])
    register_recording(project, open_recording(people))
    return project


def truths_of(people: Path) -> list[list[Truth]]:
    recording = open_recording(people)
    return [load_truth(recording, index, recording.frame(index)) for index in range(len(recording))]


def propose(project: Project, boxes: list[list[OrientedBox]]) -> None:
    """One proposal for each box, in the order of the frames."""
    for stored, each in zip(project.frames.of(), boxes, strict=True):
        image_box = Box2D("person", 1.0, 2.0, 30.0, 40.0)
        new = [Proposal("person", 0.8, box, image_box, (), Quality(0.1, 0.9, 0.1)) for box in each]
        project.proposals.replace(stored.id, new, WriteContext(stored.revision, "rcv", Source.AUTO))


def test_wrong_proposals_are_corrected_missing_ones_drawn_others_rejected(room: Project, people: Path) -> None:
    truths = truths_of(people)
    boxes = [[truth.box for truth in each] for each in truths]
    boxes[0][0] = moved(boxes[0][0], (0.3, 0.0, 0.0))
    missing = boxes[1].pop()
    boxes[2].append(moved(boxes[2][0], (0.0, 0.0, 5.0)))
    propose(room, boxes)
    operator = Operator(room, room.frames.of(), QUALITY, 2.0, 0)
    operator.review(False)
    left, bill = operator.left(), sum(operator.desk.bills.values(), Bill())
    assert (left.missed, left.wrong) == (0, 0)
    assert bill.actions["reject"] == 1
    assert bill.actions["draw on image"] == 1
    assert sum(bill.actions[kind] for kind in ("drag box", "drag edge", "drag corner", "refit", "draw on view")) >= 1
    drawn = room.labels.of_frame(room.frames.of()[1].id)
    assert max(iou_3d(label.box, missing) for label in drawn) >= QUALITY
