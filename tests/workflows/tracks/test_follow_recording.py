"""Following reviewed boxes through a recording: right boxes, honest stops, one action that can be undone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import pytest

from annotator.cli.main import main
from annotator.geometry.iou import iou_3d
from annotator.project import FramePart, NewLabel, Project, StoredFrame, WriteContext
from annotator.project.changes import FrameFinalised
from annotator.project.log import Writer
from annotator.types import BoxKind, Label, OrientedBox, ReviewState, Source, Truth
from annotator.types.errors import ConfigError, FrameError, NotFoundError, StaleRevisionError
from annotator.workflows.detectors import Detectors
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.tracks import follow_run
from annotator.workflows.tracks.follow_run import KEY_CHANGED, Following, FollowRun, follow_from_frame, follow_recording
from annotator.workflows.workbench.loaded_detectors import ReadyDetector

ANN = "ann"


@pytest.fixture
def view(knowing: Callable[..., Detectors]) -> ReadyDetector:
    return ReadyDetector(knowing("people").view, BoxKind.BOX, Lock())


def accept_truth(project: Project, frame: StoredFrame, truths: Sequence[Truth]) -> None:
    """Creates accepted labels of true boxes with their true tracks."""
    context = WriteContext(project.frames.get(frame.id).revision, ANN)
    project.labels.create(frame.id, [NewLabel(t.label, t.box, track_id=t.track_id) for t in truths], context)


def recording_of(project: Project) -> int:
    return project.recordings.all()[0].id


def labels_of(project: Project, index: int) -> list[Label]:
    return list(project.labels.of_frame(project.frames.of()[index].id))


def test_reviewed_boxes_are_followed_to_the_end(
    people: Project, truths: list[list[Truth]], view: ReadyDetector
) -> None:
    frames = people.frames.of()
    accept_truth(people, frames[0], truths[0])
    seen: list[tuple[int, int]] = []
    done = follow_recording(people, recording_of(people), view, ANN, progress=lambda k, n: seen.append((k, n)))
    assert len(done.tracks) == len(truths[0])
    total = len(truths[0]) * (len(frames) - 1)
    assert [at for at, _ in seen] == sorted({at for at, _ in seen})
    assert seen[-1] == (total, total)
    for index in range(1, len(frames)):
        labels = labels_of(people, index)
        assert {label.state for label in labels} <= {ReviewState.PROPOSED}
        for label in labels:
            truth = next(t for t in truths[index] if t.track_id == label.track_id)
            assert iou_3d(label.box, truth.box) > 0.7
    followed = sum(track.boxes for track in done.tracks)
    assert followed == sum(len(labels_of(people, index)) for index in range(1, len(frames)))
    assert followed >= 0.8 * sum(map(len, truths[1:]))
    people.history.undo(ANN)
    assert [labels_of(people, index) for index in range(1, len(frames))] == [[]] * (len(frames) - 1)


def test_a_track_is_followed_backward_and_between_its_reviewed_boxes(
    people: Project, truths: list[list[Truth]], view: ReadyDetector
) -> None:
    frames = people.frames.of()
    track = truths[2][0].track_id
    chosen = [[t for t in of_frame if t.track_id == track] for of_frame in truths]
    accept_truth(people, frames[2], chosen[2])
    done = follow_recording(people, recording_of(people), view, ANN, forward=False, backward=True, tracks=[track])
    assert {index for index in range(5) if labels_of(people, index)} == {0, 1, 2}
    people.history.undo(ANN)
    accept_truth(people, frames[4], chosen[4])
    done = follow_recording(people, recording_of(people), view, ANN, tracks=[track])
    assert {index for index in range(5) if labels_of(people, index)} == {2, 3, 4}
    (label,) = labels_of(people, 3)
    assert iou_3d(label.box, chosen[3][0].box) > 0.7
    assert (done.tracks[0].track_id, done.tracks[0].boxes, done.tracks[0].stops) == (track, 1, ())


def accept_nothing(project: Project, frame: StoredFrame, truth: Truth) -> None:
    """Creates an accepted label of track 1 where there is no object: a box in the air above one."""
    box = OrientedBox.from_parts(truth.box.center_m - [0.0, 0.9 * truth.box.size_m[2], 0.0], np.eye(3), np.full(3, 0.3))
    context = WriteContext(project.frames.get(frame.id).revision, ANN)
    project.labels.create(frame.id, [NewLabel("person", box, track_id=1)], context)


def test_no_detector_is_needed(people: Project, truths: list[list[Truth]]) -> None:
    frames = people.frames.of()
    accept_truth(people, frames[0], truths[0])
    done = follow_recording(people, recording_of(people), None, ANN)
    assert sum(track.boxes for track in done.tracks) >= 0.8 * sum(map(len, truths[1:]))
    size_of = {truth.track_id: truth.box.size_m for truth in truths[0]}
    for index in range(1, len(frames)):
        for label in labels_of(people, index):
            truth = next(t for t in truths[index] if t.track_id == label.track_id)
            np.testing.assert_allclose(label.box.size_m, size_of[truth.track_id])
            assert iou_3d(label.box, truth.box) > 0.5


def test_a_lost_object_is_reported_and_stores_nothing(
    people: Project, truths: list[list[Truth]], view: ReadyDetector
) -> None:
    frames = people.frames.of()
    with pytest.raises(ConfigError, match="there is no reviewed box to follow"):
        follow_recording(people, recording_of(people), view, ANN)
    accept_nothing(people, frames[0], truths[0][0])
    (track,) = follow_recording(people, recording_of(people), view, ANN).tracks
    (stop,) = track.stops
    assert (track.boxes, stop.frame_id, stop.reason) == (0, frames[1].id, "too few points are left")
    with pytest.raises(ConfigError, match="track 99 has no reviewed box to follow"):
        follow_recording(people, recording_of(people), view, ANN, tracks=[99])
    assert labels_of(people, 1) == []


def test_reviewed_boxes_and_finalised_frames_stay(
    people: Project, truths: list[list[Truth]], view: ReadyDetector
) -> None:
    frames = people.frames.of()
    accept_truth(people, frames[0], truths[0][:1])
    people.log.append(frames[1].id, [FrameFinalised()], WriteContext(frames[1].revision, ANN, Source.MANUAL))
    follow_recording(people, recording_of(people), view, ANN)
    assert labels_of(people, 1) == []
    assert len(labels_of(people, 2)) == 1


def test_the_command_says_what_it_did(
    people: Project,
    truths: list[list[Truth]],
    view: ReadyDetector,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("annotator.cli.tracks.view_with_classes", lambda _: view)
    accept_truth(people, people.frames.of()[0], truths[0][:1])
    name = people.recordings.all()[0].name
    assert main(["follow", people.path.name, name, "--projects", str(people.path.parent)]) == 0
    assert f"track {truths[0][0].track_id} (person): 4 boxes proposed" in capsys.readouterr().out


def follow_one(
    project: Project, view: ReadyDetector, uid: str | None, index: int = 0, forward: bool = True
) -> FollowRun:
    frame = project.frames.of()[index]
    return follow_from_frame(project, frame.id, frame.revision, view, ANN, uid=uid, forward=forward)


def untracked(project: Project, truths: list[list[Truth]], index: int = 0) -> list[str]:
    """Accepts the true boxes of a frame without their tracks; returns their labels."""
    frame = project.frames.of()[index]
    new = [NewLabel(truth.label, truth.box) for truth in truths[index]]
    return list(project.labels.create(frame.id, new, WriteContext(frame.revision, ANN)).uids)


def test_boxes_of_a_frame_are_followed_together_and_each_appears_at_once(
    people: Project, truths: list[list[Truth]], view: ReadyDetector
) -> None:
    accept_truth(people, people.frames.of()[2], truths[2])
    states: list[tuple[Following, int]] = []
    ends = follow_one(people, view, None, 2).run(lambda state: states.append((state, len(labels_of(people, 3)))))
    first, stored = states[0]
    assert {frame for frame, _ in first.proposed} == {people.frames.of()[3].id}
    assert len(first.proposed) == stored == 3
    assert [state.done for state, _ in states] == [3, 6]
    assert [track.boxes for track in ends.tracks] == [2, 2, 2]
    assert labels_of(people, 1) == []
    people.history.undo(ANN)
    assert labels_of(people, 3) == labels_of(people, 4) == []
    people.history.redo(ANN)
    assert len(labels_of(people, 3)) == len(labels_of(people, 4)) == 3


def test_a_followed_label_without_a_track_gets_the_new_one_with_one_undo(
    people: Project, truths: list[list[Truth]], view: ReadyDetector
) -> None:
    first, *_ = untracked(people, truths)
    run = follow_one(people, view, first)
    run.run()
    (track,) = run.state.tracks
    assert track.track_id == people.labels.get(first).label.track_id == 1
    assert [label.track_id for index in range(1, 5) for label in labels_of(people, index)] == [1] * 4
    assert people.history.next(ANN)[0] == "propose 4 labels (frames 000000 to 000004)"
    people.history.undo(ANN)
    assert people.labels.get(first).label.track_id is None
    assert [labels_of(people, index) for index in range(1, 5)] == [[]] * 4


def test_boxes_without_tracks_get_different_ones(
    people: Project, truths: list[list[Truth]], view: ReadyDetector
) -> None:
    uids = untracked(people, truths)
    follow_recording(people, recording_of(people), view, ANN)
    assert {people.labels.get(uid).label.track_id for uid in uids} == {1, 2, 3}


def test_undo_takes_the_actions_during_a_run_first(
    people: Project, truths: list[list[Truth]], view: ReadyDetector
) -> None:
    frames = people.frames.of()
    accept_truth(people, frames[0], truths[0][:1])

    def accept_the_first(state: Following) -> None:
        if state.done == 1:
            ((frame_id, uid),) = state.proposed
            people.labels.accept(frame_id, uid, WriteContext(people.frames.get(frame_id).revision, ANN))

    follow_one(people, view, None).run(accept_the_first)
    assert [len(labels_of(people, index)) for index in range(5)] == [1] * 5
    assert people.history.undo(ANN).words.startswith("accept")
    assert people.history.undo(ANN).words == "propose 4 labels (frames 000001 to 000004)"
    assert [len(labels_of(people, index)) for index in range(5)] == [1, 0, 0, 0, 0]


def test_a_run_can_be_stopped_and_keeps_its_boxes(
    people: Project, truths: list[list[Truth]], view: ReadyDetector
) -> None:
    accept_truth(people, people.frames.of()[0], truths[0][:1])
    run = follow_one(people, view, None)
    done = run.run(stopped=lambda: run.state.done == 2)
    assert (done.done, done.total) == (2, 4)
    assert [len(labels_of(people, index)) for index in range(5)] == [1, 1, 1, 0, 0]


def test_a_stop_between_two_reviewed_boxes_keeps_what_was_found_from_either(
    people: Project, truths: list[list[Truth]], view: ReadyDetector
) -> None:
    frames = people.frames.of()
    for index in (0, 4):
        accept_truth(people, frames[index], truths[index][:1])
    run = follow_one(people, view, None)
    told: list[int] = []
    done = run.run(lambda state: told.append(len(state.proposed)), lambda: run.state.done == 2)
    assert (done.done, done.total) == (2, 6)
    assert [len(labels_of(people, index)) for index in range(5)] == [1, 1, 0, 1, 1]
    assert told == [0, 2]
    people.history.undo(ANN)
    assert [len(labels_of(people, index)) for index in range(5)] == [1, 0, 0, 0, 1]


def test_a_changed_class_of_the_reviewed_box_ends_its_run(
    make_project: Callable[..., Project], generated: Path, truths: list[list[Truth]], view: ReadyDetector
) -> None:
    people = make_project(generated / "people", classes=("person", "other"))
    frames = people.frames.of()
    accept_truth(people, frames[0], truths[0][:1])
    (label,) = labels_of(people, 0)

    def rename(state: Following) -> None:
        if state.done == 1:
            people.labels.edit(frames[0].id, label.uid, context_of(people, 0), label="other", box=label.box)

    (track,) = follow_one(people, view, None).run(rename).tracks
    assert (track.boxes, [stop.reason for stop in track.stops]) == (1, [KEY_CHANGED])


def test_a_changed_reviewed_box_ends_its_run(people: Project, truths: list[list[Truth]], view: ReadyDetector) -> None:
    frames = people.frames.of()
    accept_truth(people, frames[0], truths[0][:2])
    (uid, _) = [label.uid for label in labels_of(people, 0)]

    def reject(state: Following) -> None:
        if state.done == 4:
            people.labels.reject(frames[0].id, uid, WriteContext(people.frames.get(frames[0].id).revision, "bob"))

    done = follow_one(people, view, None).run(reject)
    changed, other = done.tracks
    assert (changed.boxes, other.boxes) == (2, 4)
    assert [(stop.key, stop.reason) for stop in changed.stops] == [(frames[0].key, KEY_CHANGED)]


def test_changes_of_other_frames_do_not_stop_a_run(
    people: Project, truths: list[list[Truth]], view: ReadyDetector, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = people.frames.of()
    accept_truth(people, frames[0], truths[0][:1])
    real, others = people.log.writer.to_frames, iter([True, True])

    def interrupted(parts: Sequence[FramePart], *rest: Any) -> object:
        """Another operator is faster, twice."""
        if next(others, False):
            part = parts[0]
            context = WriteContext(people.frames.get(part.frame_id).revision, "bob")
            people.labels.create(part.frame_id, [NewLabel("person", truths[1][1].box)], context)
        return real(parts, *rest)

    monkeypatch.setattr(Writer, "to_frames", lambda _, *given: interrupted(*given))
    (track,) = follow_one(people, view, None).run().tracks
    assert (track.boxes, track.stops) == (4, ())
    assert len(labels_of(people, 1)) == 3


def before_storing(monkeypatch: pytest.MonkeyPatch, *actions: Callable[[], object]) -> None:
    """Lets others act after a frame's labels are read, and before its new boxes are stored; one action at a time."""
    waiting = iter(actions)
    real = follow_run.proposal_events

    def events(*given: Any) -> object:
        made = real(*given)
        next(waiting, lambda: None)()
        return made

    monkeypatch.setattr(follow_run, "proposal_events", events)


def context_of(project: Project, index: int, author: str = "bob") -> WriteContext:
    return WriteContext(project.frames.of()[index].revision, author)


def test_a_proposal_that_is_accepted_while_boxes_are_stored_stays(
    people: Project, truths: list[list[Truth]], view: ReadyDetector, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = people.frames.of()
    accept_truth(people, frames[0], truths[0][:1])
    follow_one(people, view, None).run()
    (uid,) = [label.uid for label in labels_of(people, 1)]
    before_storing(monkeypatch, lambda: people.labels.accept(frames[1].id, uid, context_of(people, 1)))
    follow_one(people, view, None).run()
    assert [(label.uid, label.state) for label in labels_of(people, 1)] == [(uid, ReviewState.ACCEPTED)]


def test_a_reviewed_box_that_is_deleted_while_boxes_are_stored_ends_its_object_only(
    people: Project, truths: list[list[Truth]], view: ReadyDetector, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second, _ = untracked(people, truths)
    frame_id = people.frames.of()[0].id
    before_storing(
        monkeypatch,
        lambda: people.labels.delete(frame_id, first, context_of(people, 0)),
        lambda: people.labels.create(frame_id, [NewLabel("person", truths[0][0].box)], context_of(people, 0)),
    )
    tracks = follow_one(people, view, None).run().tracks
    assert [track.boxes for track in tracks] == [0, 4, 4]
    assert [stop.reason for stop in tracks[0].stops] == [KEY_CHANGED], "reported once, although stored in three tries"
    assert people.labels.get(second).label.track_id is not None


def test_a_track_id_that_another_operator_takes_meanwhile_is_not_used(
    people: Project, truths: list[list[Truth]], view: ReadyDetector, monkeypatch: pytest.MonkeyPatch
) -> None:
    (uid, *_) = untracked(people, truths)
    other = NewLabel("person", truths[4][1].box, track_id=1)
    # in a frame that the run does not store at that time, so that no revision tells it
    before_storing(monkeypatch, lambda: people.labels.create(people.frames.of()[4].id, [other], context_of(people, 4)))
    (track,) = follow_one(people, view, uid).run().tracks
    assert (track.track_id, people.labels.get(uid).label.track_id) == (2, 2)


@pytest.mark.parametrize("broken", [0, 2])
def test_an_unreadable_frame_is_named_where_it_stops(
    people: Project,
    truths: list[list[Truth]],
    view: ReadyDetector,
    monkeypatch: pytest.MonkeyPatch,
    broken: int,
) -> None:
    frames = people.frames.of()
    accept_truth(people, frames[0], truths[0][:1])
    read = FrameSource.read

    def fail(source: FrameSource, frame: StoredFrame) -> object:
        if frame.id == frames[broken].id:
            raise FrameError(Path("depth.png"), "broken")
        return read(source, frame)

    monkeypatch.setattr(FrameSource, "read", fail)
    (track,) = follow_one(people, view, None).run().tracks
    assert [(stop.key, stop.reason) for stop in track.stops] == [(frames[broken].key, "depth.png: broken")]
    assert track.boxes == max(broken - 1, 0)


def test_a_stretch_ends_at_the_next_reviewed_box(
    people: Project, truths: list[list[Truth]], view: ReadyDetector
) -> None:
    frames = people.frames.of()
    for index in (0, 3):
        accept_truth(people, frames[index], truths[index][:1])
    uid = labels_of(people, 3)[0].uid
    (track,) = follow_one(people, view, uid, 3, forward=False).run().tracks
    assert track.boxes == 2
    assert [len(labels_of(people, index)) for index in range(5)] == [1, 1, 1, 1, 0]


def test_what_cannot_be_followed_is_refused(people: Project, truths: list[list[Truth]], view: ReadyDetector) -> None:
    frames = people.frames.of()
    with pytest.raises(ConfigError, match="frame 000000 has no reviewed box to follow; accept one first"):
        follow_one(people, view, None)
    for index in (0, 1, 4):
        accept_truth(people, frames[index], truths[index][:1])
    with pytest.raises(StaleRevisionError):
        follow_from_frame(people, frames[0].id, 0, view, ANN)
    with pytest.raises(NotFoundError, match="frame 000000 has no label nobody"):
        follow_one(people, view, "nobody")
    with pytest.raises(ConfigError, match="frame 000000 is the first of its recording"):
        follow_one(people, view, None, 0, forward=False)
    with pytest.raises(ConfigError, match="frame 000004 is the last of its recording"):
        follow_one(people, view, None, 4)
    with pytest.raises(ConfigError, match="the next frame of frame 000000 has a reviewed box of this track already"):
        follow_one(people, view, None, 0)


def test_only_reviewed_boxes_are_followed(people: Project, truths: list[list[Truth]], view: ReadyDetector) -> None:
    (uid, *_) = untracked(people, truths)
    frame = people.frames.of()[0]
    people.labels.reject(frame.id, uid, WriteContext(frame.revision, ANN))
    with pytest.raises(ConfigError, match="this box is not reviewed; accept it first"):
        follow_one(people, view, uid)
