"""Recordings that are removed, and come back with their labels."""

from __future__ import annotations

from pathlib import Path

import pytest
from store_samples import box_at, by_hand, by_machine, proposal_at, some_boxes, sorted_state, state_of

from annotator.project import NewLabel, Project, StoredRecording, open_project
from annotator.project.backup.repair import repair
from annotator.project.backup.verify import verify
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, AttributeKind, ClassStyle
from annotator.project.classes.edit import ClassEdit
from annotator.project.overview import list_frames, read_page
from annotator.types import BoxKind, Correction
from annotator.types.errors import NotFoundError, ProjectError

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
    assert (project.frames.count_present(), list_frames(project)[1], project.boxes.on_images()) == (2, 2, ())
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


def test_a_class_that_only_a_removed_recording_uses_stays(
    project: Project, recording: StoredRecording, other: StoredRecording
) -> None:
    project.recordings.remove(recording.id, "ann")
    hidden = state_of(project)
    with pytest.raises(ProjectError, match="'hand' cannot be removed while boxes use it"):
        project.configure(classes=["person"])
    assert project.configure(classes=["person", "hand", "foot"]).classes == ("person", "hand", "foot")
    assert state_of(project) == hidden
    assert verify(project.path, deep=True).problems == ()


def test_labels_of_a_removed_recording_follow_a_changed_class(
    project: Project, recording: StoredRecording, other: StoredRecording
) -> None:
    project.recordings.remove(recording.id, "ann")
    project.change_classes(lambda config: edit.rename_class(config, "hand", "palm"), "ann")
    assert [entry.label.label for entry in project.labels.select()] == ["person"]
    assert verify(project.path, deep=True).problems == ()
    project.recordings.rescan(recording.id, KEYS)
    assert [entry.label.label for entry in project.labels.select()] == ["palm", "palm", "person"]
    assert verify(project.path, deep=True).problems == ()


def test_a_change_of_looks_leaves_what_is_hidden_alone(
    project: Project, recording: StoredRecording, other: StoredRecording, monkeypatch: pytest.MonkeyPatch
) -> None:
    size = Attribute(name="size", kind=AttributeKind.INTEGER, default=1)
    project.change_classes(lambda config: edit.put_attribute(config, size), "ann")
    last = project.frames.of()[-1]
    (label,) = project.labels.of_frame(last.id)
    project.labels.set_attributes(last.id, label.uid, {"size": None}, by_hand(last.revision))
    project.recordings.remove(recording.id, "ann")
    looks = (
        lambda config: edit.style_class(config, "hand", ClassStyle(colour="#3366ff", key="h")),
        lambda config: edit.put_attribute(config, size.model_copy(update={"key": "s", "required": True})),
        lambda config: edit.add_class(config, "foot"),
    )
    others = (
        lambda config: edit.put_attribute(config, size.model_copy(update={"default": 2})),
        lambda config: edit.put_attribute(config, size.model_copy(update={"maximum": 0.0, "default": None})),
        lambda config: ClassEdit(edit.with_classes(config, ["person"])),
    )
    with monkeypatch.context() as patched:
        patched.setattr("annotator.project.recordings.show_again", lambda *_: pytest.fail("rows were moved"))
        for change in looks:
            project.change_classes(change, "ann")
        # no value comes back
        assert project.labels.get(label.uid).label.attributes == {}
        for change in others:
            with pytest.raises(pytest.fail.Exception):
                project.change_classes(change, "ann")
    for change in others[1:]:
        with pytest.raises(ProjectError, match=r"would not fit|cannot be removed"):
            project.change_classes(change, "ann")
    assert verify(project.path, deep=True).problems == ()


def test_changes_of_a_removed_recording_are_undone_only_once_it_is_back(
    project: Project, recording: StoredRecording, other: StoredRecording
) -> None:
    assert project.history.next("ann")[0] == "finalise frame 0"
    project.recordings.remove(recording.id, "bea")
    assert project.history.next("ann")[0] == "draw person (frame b)"
    project.recordings.rescan(recording.id, KEYS)
    assert project.history.undo("ann").words == "finalise frame 0"
    project.recordings.remove(recording.id, "bea")
    assert project.history.next("ann") == ("draw person (frame b)", None)
    assert project.history.undo("ann").words == "draw person (frame b)"


def test_a_removed_recording_that_has_moved_comes_back_at_its_new_place(
    project: Project, recording: StoredRecording, other: StoredRecording, tmp_path: Path
) -> None:
    before = sorted_state(project)
    project.recordings.remove(recording.id, "ann")
    with pytest.raises(ProjectError, match="it lacks frames 0, 1"):
        project.recordings.move(recording.id, tmp_path / "new", KEYS[2:], "ann")
    assert project.recordings.all() == (other,)
    assert project.recordings.move(recording.id, tmp_path / "new", KEYS, "ann").path == tmp_path / "new"
    assert sorted_state(project) == before


def test_a_removed_recording_gives_up_its_place_to_one_that_moves_there(
    project: Project, recording: StoredRecording, other: StoredRecording
) -> None:
    with pytest.raises(ProjectError, match="first run `annotator project remove PROJECT take`"):
        project.recordings.move(other.id, recording.path, ["a", "b"], "ann")
    project.recordings.remove(recording.id, "ann")
    assert project.recordings.move(other.id, recording.path, ["a", "b"], "ann").path == recording.path
    assert project.recordings.move(recording.id, other.path, KEYS, "ann").path == other.path


def test_a_project_that_is_saved_from_its_events_has_no_removed_labels(
    project: Project, recording: StoredRecording, other: StoredRecording
) -> None:
    project.recordings.remove(recording.id, "ann")
    (project.path / "project.json").unlink()
    with open_project(repair(project.path).path) as saved:
        assert [entry.label.label for entry in saved.labels.select()] == ["person"]
        saved.recordings.rescan(recording.id, KEYS)
        assert len(saved.labels.select()) == 3
