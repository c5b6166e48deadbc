"""The benchmark of reviewing: the keystroke-level model, the plans of the hand, and the simulated operator."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from annotator.geometry.iou import iou_3d
from annotator.project import WriteContext, create_project
from annotator.recordings import open_recording
from annotator.types import Box2D, OrientedBox, Proposal, Quality, Source
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.recorded.reading import load_truth
from benchmarks.review_moves import Bill
from benchmarks.review_operator import Operator

QUALITY = 0.7


def moved(box: OrientedBox, along: tuple[float, float, float]) -> OrientedBox:
    """A box shifted along its own axes, metres."""
    return OrientedBox.from_parts(box.center_m + box.rotation @ np.array(along), box.rotation, box.size_m)


def test_wrong_proposals_are_corrected_missing_ones_drawn_others_rejected(generated: Path, tmp_path: Path) -> None:
    room, recording = create_project(tmp_path, "room", ["person"]), open_recording(generated / "people")
    register_recording(room, recording)
    boxes = [[truth.box for truth in load_truth(recording, n, recording.frame(n))] for n in range(len(recording))]
    boxes[0][0] = moved(boxes[0][0], (0.3, 0.0, 0.0))
    missing = boxes[1].pop()
    boxes[2].append(moved(boxes[2][0], (0.0, 0.0, 5.0)))
    for stored, each in zip(room.frames.of(), boxes, strict=True):
        image_box = Box2D("person", 1.0, 2.0, 30.0, 40.0)
        new = [Proposal("person", 0.8, box, image_box, (), Quality(0.1, 0.9, 0.1)) for box in each]
        room.proposals.replace(stored.id, new, WriteContext(stored.revision, "rcv", Source.AUTO))
    operator = Operator(room, room.frames.of(), QUALITY, 2.0, 0)
    operator.review(False)
    left, bill = operator.left(), sum(operator.desk.bills.values(), Bill())
    assert (left.missed, left.wrong) == (0, 0)
    assert bill.actions["reject"] == 1
    assert bill.actions["draw on image"] == 1
    assert sum(bill.actions[kind] for kind in ("drag box", "drag edge", "drag corner", "refit", "draw on view")) >= 1
    drawn = room.labels.of_frame(room.frames.of()[1].id)
    assert max(iou_3d(label.box, missing) for label in drawn) >= QUALITY
