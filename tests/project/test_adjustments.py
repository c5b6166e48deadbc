"""The up direction and the correction of a recording: events, undoable, and what they do to what is stored."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from store_samples import box_at, by_hand, by_machine, proposal_at, some_boxes

from annotator.geometry.oriented_box import same_box
from annotator.project import Basis, NewLabel, Project, StoredRecording, ViewGeometry
from annotator.types import NO_CORRECTION, Box2D, BoxKind, Correction, OrientedBox
from annotator.types.errors import StaleRevisionError

TURNED = Correction((0.0, 0.3, 0.05), (0.1, -0.2, 0.4))
AGAIN = Correction((0.2, 0.0, 0.0), (0.0, 0.0, 1.0))


def box_of(project: Project, frame: int) -> OrientedBox:
    (label,) = project.labels.of_frame(frame)
    return label.box


@pytest.fixture
def labelled(project: Project, frame: int) -> int:
    """The frame with one label."""
    project.labels.create(frame, [NewLabel("hand", box_at())], by_hand())
    return frame


def test_up_is_set_turns_with_the_cloud_and_returns_to_what_the_recording_was_added_with(project: Project, tmp_path):
    added = project.recordings.add(tmp_path / "other", "rgbd", "other", ["0"], True, up=[0, -1, 0])
    project.adjustments.set_up(added.id, [0.0, -3.0, -4.0], "ann")
    assert project.recordings.get(added.id).up == pytest.approx((0.0, -0.6, -0.8))
    assert project.history.next("ann") == ("set up of other", None)
    project.adjustments.correct(added.id, TURNED, "ann")
    turned = Rotation.from_rotvec(TURNED.turn_rad).apply([0.0, -0.6, -0.8])
    assert project.recordings.get(added.id).up == pytest.approx(turned)
    project.adjustments.set_up(added.id, None, "ann")
    assert project.recordings.get(added.id).up is None
    for up in (turned, (0.0, -0.6, -0.8), (0.0, -1.0, 0.0)):
        project.history.undo("ann")
        assert project.recordings.get(added.id).up == pytest.approx(up)


def test_up_leaves_boxes_and_a_correction_moves_them_with_the_cloud(project: Project, recording, labelled: int):
    before = box_of(project, labelled)
    project.adjustments.set_up(recording.id, [0.0, -1.0, 0.0], "ann")
    assert same_box(box_of(project, labelled), before)
    # a second correction replaces the first one
    for correction in (TURNED, AGAIN, NO_CORRECTION):
        project.adjustments.correct(recording.id, correction, "ann")
        assert same_box(box_of(project, labelled), before.transformed(correction.T_camera_recorded))
        assert project.recordings.get(recording.id).correction == correction


def test_boxes_of_finalised_frames_and_open_proposals_move_and_other_recordings_stay(
    project: Project, recording: StoredRecording, labelled: int, tmp_path
):
    other = project.recordings.add(tmp_path / "other", "rgbd", "other", ["0"], True)
    foreign = project.frames.find(other.id, "0").id
    project.labels.create(foreign, [NewLabel("hand", box_at())], by_hand())
    project.frames.finalise(labelled, by_hand(1))
    open_ = project.frames.find(recording.id, "0").id
    project.proposals.replace(open_, [proposal_at()], by_machine())
    project.adjustments.correct(recording.id, TURNED, "ann")
    latest = project.proposals.latest(open_)
    assert latest is not None
    proposed = project.proposals.boxes(recording.id).values()
    expected = box_at().transformed(TURNED.T_camera_recorded)
    for moved in (box_of(project, labelled), box_of(project, open_), *proposed, latest[0][1]):
        assert same_box(moved, expected)
    assert same_box(box_of(project, foreign), box_at())
    assert project.frames.get(foreign).revision == 1


def test_views_keep_their_points(project: Project, recording: StoredRecording, frame: int):
    point = np.array([0.3, -0.2, 2.0])
    axes = Rotation.from_euler("xyz", [0.4, 0.2, -0.3]).as_matrix()
    geometry = ViewGeometry(
        axes=tuple(map(tuple, axes.tolist())),
        metres_per_px=0.01,
        origin_m=(0.5, -0.7),
        image_box=Box2D("hand", 0.0, 0.0, 9.0, 9.0),
    )
    view = project.views.store(np.zeros((4, 4, 3), np.uint8))
    project.boxes.set_on_view(view, some_boxes(1), BoxKind.BOX, by_hand(), frame_id=frame, step=0, geometry=geometry)
    project.adjustments.correct(recording.id, TURNED, "ann")
    moved = project.boxes.on_views()[0].geometry
    assert moved is not None
    there = TURNED.T_camera_recorded.apply(point)
    before = axes[:2] @ point - geometry.origin_m
    assert np.allclose(np.array(moved.axes)[:2] @ there - moved.origin_m, before)
    assert moved.image_box == geometry.image_box


def test_changes_that_are_based_on_the_earlier_geometry_are_refused(project: Project, recording, labelled: int):
    seen = project.recordings.get(recording.id).adjusted
    project.adjustments.correct(recording.id, TURNED, "ann", Basis(adjusted=seen))
    with pytest.raises(StaleRevisionError):
        project.labels.create(labelled, [NewLabel("hand", box_at())], by_hand(1))
    with pytest.raises(StaleRevisionError):
        project.adjustments.correct(recording.id, AGAIN, "bob", Basis(adjusted=seen))
    assert project.recordings.get(recording.id).correction == TURNED


def test_a_correction_that_changes_nothing_is_no_step_to_undo(project: Project, recording: StoredRecording):
    for _ in range(2):
        project.adjustments.correct(recording.id, TURNED, "ann")
        assert project.history.next("ann")[0] is not None
    assert project.history.undo("ann").words == "correct the calibration of take"
    assert project.recordings.get(recording.id).correction == NO_CORRECTION


def test_undo_of_an_older_edit_puts_the_box_where_the_cloud_is_now(project: Project, recording, labelled: int):
    uid = project.labels.of_frame(labelled)[0].uid
    project.labels.edit(labelled, uid, by_hand(1, "bob"), label="hand", box=box_at(5.0))
    project.adjustments.correct(recording.id, TURNED, "ann")
    project.history.undo("bob")
    assert same_box(box_of(project, labelled), box_at().transformed(TURNED.T_camera_recorded))


def test_an_untouched_proposal_counts_as_untouched_after_a_correction(project: Project, recording, frame: int):
    project.proposals.replace(frame, [proposal_at()], by_machine())
    project.labels.accept(frame, project.labels.of_frame(frame)[0].uid, by_hand(1))
    project.adjustments.correct(recording.id, TURNED, "ann")
    review = project.statistics()
    assert (review.accepted_untouched, review.iou_proposal_to_final) == (1.0, pytest.approx(1.0))


@pytest.mark.parametrize(
    "wrong", [{"turn_rad": (4.0, 0.0, 0.0)}, {"shift_m": (np.inf, 0.0, 0.0)}, {"time_offset_s": np.nan}]
)
def test_a_correction_is_finite_and_bounded(wrong):
    with pytest.raises(ValueError, match="finite"):
        Correction(**wrong)


def test_a_recording_was_corrected_whatever_has_followed(project: Project, recording: StoredRecording):
    project.adjustments.set_up(recording.id, [0.0, -1.0, 0.0], "ann")
    assert project.adjustments.corrected() == frozenset()
    project.adjustments.correct(recording.id, TURNED, "ann")
    for change in (
        lambda: project.adjustments.set_up(recording.id, [0.0, 0.0, -1.0], "ann"),
        lambda: project.adjustments.correct(recording.id, NO_CORRECTION, "ann"),
    ):
        change()
        assert project.adjustments.corrected() == {recording.id}
