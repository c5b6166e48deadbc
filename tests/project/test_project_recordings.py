"""Recordings: registered, moved, removed; their up direction and correction."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from store_samples import box_at, by_hand, by_machine, proposal_at, some_boxes, sorted_state, state_of

from annotator.geometry.oriented_box import same_box
from annotator.project import Basis, NewLabel, Project, StoredRecording, ViewGeometry
from annotator.project.backup.verify import verify
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, AttributeKind
from annotator.project.classes.edit import ClassEdit
from annotator.project.overview import read_page
from annotator.types import NO_CORRECTION, Box2D, BoxKind, Correction, OrientedBox
from annotator.types.errors import NotFoundError, ProjectError, StaleRevisionError


def _keys(project: Project) -> list[tuple[str, int | None]]:
    return [(frame.key, frame.index) for frame in project.frames.of()]


def moved_to(project: Project, recording: StoredRecording, path: Path, keys: list[str]) -> StoredRecording:
    return project.recordings.move({recording.id: (path, keys)})[0]


def test_a_recording_is_registered_with_its_frames(project: Project, tmp_path: Path) -> None:
    added = project.recordings.add(tmp_path / "walk", "kitti", "walk", ["a", "b"], True, [0, -2, 0])
    assert added.path == tmp_path / "walk"
    assert (added.format, added.name, added.is_sequence, added.frames) == ("kitti", "walk", True, 2)
    assert added.up == (0.0, -1.0, 0.0)
    assert project.recordings.get(added.id) == added
    assert project.recordings.find("walk") == added
    assert [(frame.key, frame.index, frame.revision, frame.finalised) for frame in project.frames.of()] == [
        ("a", 0, 0, False),
        ("b", 1, 0, False),
    ]


@pytest.mark.parametrize("up", [[0, 0, 0], [1, 2], [np.nan, 0, 1]])
def test_an_invalid_up_direction_is_refused(project: Project, tmp_path: Path, up: object) -> None:
    with pytest.raises(ProjectError, match="up direction"):
        project.recordings.add(tmp_path, "kitti", "walk", ["a"], True, up)
    assert project.recordings.all() == ()


def test_the_same_recording_twice_is_refused(project: Project, recording: StoredRecording) -> None:
    detour = recording.path.parent / "x" / ".." / recording.path.name
    with pytest.raises(ProjectError, match="is in the project already"):
        project.recordings.add(detour, "rgbd", "other", ["a"], True)
    again = project.recordings.add(recording.path, "rgbd", "other", ["a"], True, options='{"camera":"left"}')
    assert (again.path, again.options) == (recording.path, '{"camera":"left"}')
    assert project.recordings.get(recording.id).options == ""


def test_recordings_with_the_same_name_get_a_suffix(project: Project, tmp_path: Path) -> None:
    names = [project.recordings.add(tmp_path / str(n), "rgbd", "seq", ["a"], True).name for n in range(3)]
    assert names == ["seq", "seq-2", "seq-3"]


def test_a_rescan_reports_new_and_missing_frames(project: Project, recording: StoredRecording) -> None:
    project.frames.finalise(project.frames.find(recording.id, "1").id, by_hand())
    rescan = project.recordings.rescan(recording.id, ["00", "0", "2", "1", "9"])
    assert (rescan.added, rescan.missing) == (("00", "9"), ("3", "4"))
    assert _keys(project) == [("00", 0), ("0", 1), ("2", 2), ("1", 3), ("9", 4), ("3", None), ("4", None)]
    assert project.frames.find(recording.id, "1").finalised
    assert project.recordings.get(recording.id).frames == 5
    again = project.recordings.rescan(recording.id, ["00", "0", "2", "1", "9", "3"])
    assert (again.added, again.missing) == ((), ("4",))
    assert _keys(project)[5] == ("3", 5)


def test_a_moved_recording_keeps_frames_and_labels(project: Project, recording: StoredRecording) -> None:
    (uid,) = project.labels.create(project.frames.of()[1].id, [NewLabel("hand", box_at())], by_hand()).uids
    before = (project.frames.of(), project.labels.get(uid).label.box.center_m.tolist())
    there, keys = recording.path.parent / "x" / ".." / "there", [str(n) for n in range(5)]
    moved = moved_to(project, recording, there, keys)
    assert moved == replace(recording, path=recording.path.parent / "there")
    assert (project.frames.of(), project.labels.get(uid).label.box.center_m.tolist()) == before
    back = moved_to(project, recording, recording.path, keys)
    assert moved_to(project, recording, recording.path, keys) == back == recording
    project.log.rebuild()
    assert project.recordings.get(recording.id) == recording
    other = project.recordings.add(recording.path.parent / "other", "rgbd", "other", keys, True)
    with pytest.raises(ProjectError, match="is in the project already, as recording other"):
        moved_to(project, recording, other.path, keys)


def test_recordings_are_moved_together_or_not_at_all(project: Project, recording: StoredRecording) -> None:
    other = project.recordings.add(recording.path, "rgbd", "other", ["0", "1"], True, options='{"camera":"left"}')
    there, keys = recording.path.parent / "there", [str(n) for n in range(5)]
    with pytest.raises(ProjectError, match="there is not other: it lacks frame 1"):
        project.recordings.move({recording.id: (there, keys), other.id: (there, ["0"])})
    assert {each.path for each in project.recordings.all()} == {recording.path}
    moved = project.recordings.move({recording.id: (there, keys), other.id: (there, ["0", "1"])})
    assert [each.path for each in moved] == [there, there]


def test_a_moved_recording_may_have_more_frames(project: Project, recording: StoredRecording) -> None:
    before = project.frames.of()
    keys = ["early", *[str(n) for n in range(5)], "late"]
    moved = moved_to(project, recording, recording.path / "there", keys)
    assert moved.frames == 7 and [key for key, _ in _keys(project)] == keys
    assert [project.frames.find(recording.id, frame.key).id for frame in before] == [frame.id for frame in before]


@pytest.mark.parametrize(
    ("keys", "problem"),
    [
        (["0", "1", "2", "4"], "it lacks frame 3; nothing was changed; give the folder with the same 5 frames"),
        (["0", "1", "2", "4", "x"], "it lacks frame 3 and also has frame x;"),
        (["a"], "it lacks frames 0, 1, 2, 3, 4 and also has frame a;"),
        ([f"{n}" for n in range(1, 12)], "it lacks frame 0 and also has frames 5, 6, 7, 8, 9 and 2 more;"),
        (["0", "0"], "'0' occurs twice"),
    ],
)
def test_a_move_to_another_recording_is_refused(
    project: Project, recording: StoredRecording, keys: list[str], problem: str
) -> None:
    before = project.frames.of()
    with pytest.raises(ProjectError, match=re.escape(problem)):
        moved_to(project, recording, recording.path / "there", keys)
    assert (project.recordings.get(recording.id), project.frames.of()) == (recording, before)


KEYS = [str(number) for number in range(5)]


@pytest.fixture
def other(project: Project, recording: StoredRecording, tmp_path: Path) -> StoredRecording:
    """A second recording, with labels; `recording` has labels, 2D boxes, a correction and a finalised frame."""
    other = project.recordings.add(tmp_path / "other", "rgbd", "other", ["a", "b"], True)
    first, second, *_, last = project.frames.of()
    project.labels.create(first.id, [NewLabel("hand", box_at())], by_hand())
    project.labels.create(last.id, [NewLabel("person", box_at(1.0))], by_hand())
    project.proposals.replace(second.id, [proposal_at()], by_machine())
    project.boxes.set_on_image(first.id, some_boxes(2), BoxKind.BOX, by_hand(1))
    project.adjustments.correct(recording.id, Correction((0.1, 0.0, 0.0), (0.0, 0.3, 0.0)), "ann")
    project.frames.finalise(first.id, by_hand(3))
    return other


def test_a_removed_recording_is_gone_and_comes_back_as_it_was(
    project: Project, recording: StoredRecording, other: StoredRecording
) -> None:
    before, counts, first = sorted_state(project), project.statistics(), project.frames.of()[0]
    adjusted = project.recordings.get(recording.id)
    project.recordings.remove(recording.id, "ann")
    assert project.recordings.all() == (other,)
    assert [entry.label.label for entry in project.labels.select()] == ["person"]
    assert {frame.recording_id for frame in project.frames.of()} == {other.id}
    assert (project.frames.count_present(), project.boxes.on_images()) == (2, ())
    run = project.jobs.start(image_detector="a", view_detector="b", config_json="{}")
    assert [frame.key for frame in project.jobs.pending(run.key)] == ["a", "b"]
    seen = project.statistics()
    assert (seen.recordings, seen.frames, seen.frames_finalised, seen.labels.total) == (1, 2, 0, 1)
    assert verify(project.path, deep=True).problems == ()

    for attempt in (
        lambda: project.recordings.get(recording.id),
        lambda: project.recordings.remove(recording.id, "ann"),
        lambda: project.frames.get(first.id),
        lambda: read_page(project, first.id),
        lambda: project.labels.create(first.id, [NewLabel("hand", box_at())], by_hand(first.revision)),
    ):
        with pytest.raises(NotFoundError):
            attempt()
    with pytest.raises(NotFoundError, match="'take' was removed from the project; `annotator add` brings it back"):
        project.recordings.find("take")
    with pytest.raises(ProjectError, match="was removed from the project; `annotator add` brings it back"):
        project.recordings.add(recording.path, "rgbd", "take", KEYS, True)

    assert project.recordings.removed()[0].removed_by == "ann"
    assert project.recordings.rescan(recording.id, KEYS).added == ()
    assert (sorted_state(project), project.recordings.get(recording.id)) == (before, adjusted)
    assert project.statistics() == counts.model_copy(update={"runs": 1})
    assert verify(project.path, deep=True).problems == ()


def test_changes_while_a_recording_is_removed_give_the_state_of_a_rebuild(
    project: Project, recording: StoredRecording, other: StoredRecording
) -> None:
    """Ids of labels, to which undo refers, are those that the events give."""
    last = project.frames.of()[-1]
    project.recordings.remove(recording.id, "bea")
    uid, _ = project.labels.create(last.id, [NewLabel("hand", box_at(n)) for n in (3.0, 4.0)], by_hand(1)).uids
    project.labels.delete(last.id, uid, by_hand(3))
    project.proposals.replace(last.id, [proposal_at(9.0), proposal_at(7.0)], by_machine(4))
    project.history.undo("ann")
    assert verify(project.path, deep=True).problems == ()
    project.recordings.rescan(recording.id, KEYS)
    assert verify(project.path, deep=True).problems == ()
    before = state_of(project)
    project.log.rebuild()
    assert state_of(project) == before


def test_changes_that_labels_of_a_removed_recording_do_not_fit_are_refused(
    project: Project, recording: StoredRecording, other: StoredRecording
) -> None:
    size = Attribute(name="size", kind=AttributeKind.INTEGER, default=1)
    project.change_classes(edit.PutAttribute(attribute=size), "ann")
    last = project.frames.of()[-1]
    (label,) = project.labels.of_frame(last.id)
    project.labels.set_attributes(last.id, label.uid, {"size": None}, by_hand(last.revision))
    project.recordings.remove(recording.id, "ann")
    looks = edit.StyleClass(name="hand", style={"colour": "#3366ff", "key": "h"})
    project.change_classes(looks, "ann")
    # no value comes back
    assert project.labels.get(label.uid).label.attributes == {}
    for change in (
        edit.PutAttribute(attribute=size.model_copy(update={"maximum": 0.0, "default": None})),
        lambda config: ClassEdit("", edit.with_classes(config, ["person"])),
    ):
        with pytest.raises(ProjectError, match=r"would not fit|cannot be removed"):
            project.change_classes(change, "ann")
    assert verify(project.path, deep=True).problems == ()


def test_a_removed_recording_that_has_moved_comes_back_at_its_new_place(
    project: Project, recording: StoredRecording, other: StoredRecording, tmp_path: Path
) -> None:
    before = sorted_state(project)
    project.recordings.remove(recording.id, "ann")
    with pytest.raises(ProjectError, match="it lacks frames 0, 1"):
        moved_to(project, recording, tmp_path / "new", KEYS[2:])
    assert project.recordings.all() == (other,)
    assert moved_to(project, recording, tmp_path / "new", KEYS).path == tmp_path / "new"
    assert sorted_state(project) == before


def test_a_removed_recording_gives_up_its_place_to_one_that_moves_there(
    project: Project, recording: StoredRecording, other: StoredRecording
) -> None:
    with pytest.raises(ProjectError, match="first run `annotator project remove PROJECT take`"):
        moved_to(project, other, recording.path, ["a", "b"])
    project.recordings.remove(recording.id, "ann")
    assert moved_to(project, other, recording.path, ["a", "b"]).path == recording.path
    assert moved_to(project, recording, other.path, KEYS).path == other.path


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
