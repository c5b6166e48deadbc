"""Correcting a box as another one was corrected."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import iou_3d
from annotator.project import Effort, NewLabel, WriteContext
from annotator.project.project import create_project
from annotator.types import Box2D, OrientedBox, Proposal, Quality, ReviewState
from annotator.workflows.tracks.copy_next import carry_correction, corrected_alike
from annotator.workflows.tracks.propose_boxes import NewProposal, part_of, proposal_events


def box(center: tuple[float, float, float], yaw_deg: float, size: tuple[float, float, float]) -> OrientedBox:
    rotation = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()
    return OrientedBox.from_parts(np.array(center), rotation, np.array(size))


def test_the_same_error_is_corrected_in_each_boxs_own_axes() -> None:
    was, now = box((0.0, 0.0, 0.0), 0.0, (4.0, 2.0, 1.5)), box((0.5, 0.0, 0.0), 10.0, (4.5, 2.0, 1.5))
    later = corrected_alike(box((10.0, 5.0, 0.0), 90.0, (4.0, 2.0, 1.5)), was, now)
    assert iou_3d(later, box((10.0, 5.5, 0.0), 100.0, (4.5, 2.0, 1.5))) > 0.999


def test_a_turn_by_90_degrees_takes_the_sides_along() -> None:
    was, now = box((0.0, 0.0, 0.0), 0.0, (2.0, 4.0, 1.5)), box((0.0, 0.0, 0.0), 90.0, (4.0, 2.0, 1.5))
    other = box((3.0, 0.0, 0.0), 20.0, (2.2, 4.0, 1.5))
    later = corrected_alike(other, was, now)
    np.testing.assert_allclose(later.size_m, (4.0, 2.2, 1.5))
    assert iou_3d(later, other) > 0.999


def test_sides_stay_positive() -> None:
    was, now = box((0.0, 0.0, 0.0), 0.0, (4.0, 2.0, 1.5)), box((0.0, 0.0, 0.0), 0.0, (1.0, 2.0, 1.5))
    assert corrected_alike(box((0.0, 0.0, 0.0), 0.0, (2.0, 2.0, 1.5)), was, now).size_m.min() > 0


def test_who_proposed_a_corrected_box_stays_known(tmp_path: Path) -> None:
    project = create_project(tmp_path, "p", ["car"])
    recording = project.recordings.add(tmp_path / "recording", "folder", "r", ["000000", "000001"], True)
    first, second = project.frames.of([recording.id])
    was, now = box((0.0, 0.0, 5.0), 0.0, (1.0, 1.0, 1.0)), box((0.2, 0.0, 5.0), 0.0, (1.0, 1.0, 1.0))
    (uid,) = project.labels.create(first.id, [NewLabel("car", now, track_id=4)], WriteContext(0, "me")).uids
    said = {"one": NewLabel("car", was, 0.9, 4), "two": NewLabel("car", was, 0.8, 4)}
    for source, label in said.items():
        project.proposals.bring(source, {second.id: [label]})
    revision = project.frames.get(first.id).revision
    carry_correction(project, first.id, uid, revision, was, "me")
    for _ in range(2):
        (stored,) = project.labels.select(states=[ReviewState.PROPOSED])
        np.testing.assert_allclose(stored.label.box.center_m, now.center_m)
        assert [(each.source, each.score, each.box.center_m[0]) for each in stored.said] == [
            ("one", 0.9, 0.0),
            ("two", 0.8, 0.0),
        ]
        # a source that comes again replaces what it said
        project.proposals.bring("one", {second.id: [said["one"]]})
    project.proposals.bring("one", {second.id: []})
    (stored,) = project.labels.select(states=[ReviewState.PROPOSED])
    assert [each.source for each in stored.said] == ["two"]
    project.log.rebuild()
    assert project.labels.select(states=[ReviewState.PROPOSED])[0].said == stored.said


def test_a_corrected_proposal_stays_the_same_one(tmp_path: Path) -> None:
    project = create_project(tmp_path, "p", ["car"])
    recording = project.recordings.add(tmp_path / "recording", "folder", "r", ["000000", "000001"], True)
    first, second = project.frames.of([recording.id])
    was, now = box((0.0, 0.0, 5.0), 0.0, (1.0, 1.0, 1.0)), box((0.2, 0.0, 5.0), 0.0, (1.0, 1.0, 1.0))
    (uid,) = project.labels.create(first.id, [NewLabel("car", now, track_id=4)], WriteContext(0, "me")).uids
    trusted = Proposal("car", 0.7, was, Box2D("car", 1.0, 2.0, 3.0, 4.0, 0.7), (), Quality(0.1, 1.0, 0.0, 0.9, 0.4))
    payloads = proposal_events(project, second, [NewProposal("car", was, 4, trusted)])
    project.log.append_to_frames([part_of(second, payloads, "me")])
    (before,) = project.labels.select(states=[ReviewState.PROPOSED])
    effort = Effort(1, 2.0)
    carry_correction(project, first.id, uid, project.frames.get(first.id).revision, was, "me", effort=effort)
    (after,) = project.labels.select(states=[ReviewState.PROPOSED])
    np.testing.assert_allclose(after.label.box.center_m, now.center_m)
    assert (after.label.uid, after.label.score, after.label.expected_iou_loss) == (before.label.uid, 0.7, 0.4)
    revision = project.frames.get(second.id).revision
    project.labels.accept(second.id, before.label.uid, WriteContext(revision, "me", effort=effort))
    figures = project.statistics()
    assert figures.iou_proposal_to_final == pytest.approx(iou_3d(was, now))
    assert figures.effort.actions_a_box == pytest.approx(2.0), "the correction and the accepting"
    project.log.rebuild()
    np.testing.assert_allclose(project.labels.get(before.label.uid).label.box.center_m, now.center_m)
    for _ in range(2):
        project.history.undo("me")
    (restored,) = project.labels.select(states=[ReviewState.PROPOSED])
    np.testing.assert_allclose(restored.label.box.center_m, was.center_m)
