"""Following reviewed boxes through a recording: right boxes, honest stops, one action that can be undone."""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain, repeat
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from moving import ANN
from true_room import Room

from annotator.cli.main import main
from annotator.geometry.iou import iou_3d
from annotator.project import NewLabel, StoredFrame, WriteContext
from annotator.project.changes import FrameFinalised
from annotator.project.log import Writer
from annotator.types import OrientedBox, ReviewState, Source
from annotator.types.errors import ConfigError, FrameError, NotFoundError, StaleRevisionError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.tracks import follow_run
from annotator.workflows.tracks.follow_run import KEY_CHANGED, Following, follow_from_frame


def test_reviewed_boxes_are_followed_to_the_end(room: Room) -> None:
    room.accept(0)
    seen: list[tuple[int, int]] = []
    done = room.all(room.view, progress=lambda k, n: seen.append((k, n)))
    assert len(done.tracks) == 3
    assert [at for at, _ in seen] == sorted({at for at, _ in seen})
    assert seen[-1] == (12, 12)
    for index in range(1, 5):
        assert {label.state for label in room.labels(index)} <= {ReviewState.PROPOSED}
        assert all(iou_3d(label.box, room.truth(index, label).box) > 0.7 for label in room.labels(index))
    followed = sum(track.boxes for track in done.tracks)
    assert followed == sum(room.counts[1:]) >= 0.8 * sum(map(len, room.truths[1:]))
    room.project.history.undo(ANN)
    assert room.counts == [3, 0, 0, 0, 0]


def test_a_lost_object_is_reported_and_stores_nothing(room: Room) -> None:
    with pytest.raises(ConfigError, match="there is no reviewed box to follow"):
        room.all(room.view)
    # a box in the air, above the farthest person
    truth = max(room.truths[0], key=lambda truth: truth.box.center_m[2])
    box = OrientedBox.from_parts(
        truth.box.center_m - [0.0, 0.75 * truth.box.size_m[2], 0.0], np.eye(3), np.full(3, 0.3)
    )
    room.project.labels.create(room.frames[0].id, [NewLabel("person", box, track_id=1)], room.context(0))
    (track,) = room.all(room.view).tracks
    (stop,) = track.stops
    assert (track.boxes, stop.frame_id, stop.reason) == (0, room.frames[1].id, "too few points are left")
    with pytest.raises(ConfigError, match="track 99 has no reviewed box to follow"):
        room.all(room.view, tracks=[99])
    assert room.labels(1) == []


def test_finalised_frames_stay(room: Room) -> None:
    room.accept(0, 1)
    room.project.log.append(
        room.frames[1].id, [FrameFinalised()], WriteContext(room.frames[1].revision, ANN, Source.MANUAL)
    )
    room.all(room.view)
    assert room.counts[:3] == [1, 0, 1]


def test_the_command_says_what_it_did(
    room: Room, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("annotator.cli.tracks.view_with_classes", lambda _: room.view)
    room.accept(0, 1)
    path, name = room.project.path, room.project.recordings.all()[0].name
    assert main(["follow", path.name, name, "--projects", str(path.parent)]) == 0
    assert f"track {room.truths[0][0].track_id} (person): 4 boxes proposed" in capsys.readouterr().out


def test_boxes_of_a_frame_are_followed_together_and_each_appears_at_once(room: Room) -> None:
    room.accept(2)
    states: list[tuple[Following, int]] = []
    ends = room.run(2).run(lambda state: states.append((state, len(room.labels(3)))))
    first, stored = states[0]
    assert first.first is not None and first.first[0] == room.frames[3].id
    assert sum(track.boxes for track in first.tracks) == stored == 3
    assert [state.done for state, _ in states] == [3, 6]
    assert [track.boxes for track in ends.tracks] == [2, 2, 2]
    assert room.counts == [0, 0, 3, 3, 3]
    room.project.history.undo(ANN)
    assert room.counts == [0, 0, 3, 0, 0]
    room.project.history.redo(ANN)
    assert room.counts == [0, 0, 3, 3, 3]


def test_undo_takes_the_actions_during_a_run_first(room: Room) -> None:
    room.accept(0, 1)

    def accept_the_first(state: Following) -> None:
        if state.done == 1:
            assert state.first is not None
            room.project.labels.accept(*state.first, room.context(1))

    room.run().run(accept_the_first)
    assert room.counts == [1] * 5
    assert room.project.history.undo(ANN).words.startswith("accept")
    assert room.project.history.undo(ANN).words == "propose 4 labels (frames 2 to 5)"
    assert room.counts == [1, 0, 0, 0, 0]


def test_a_stop_between_two_reviewed_boxes_keeps_what_was_found_from_either(room: Room) -> None:
    for index in (0, 4):
        room.accept(index, 1)
    run = room.run()
    told: list[int] = []
    done = run.run(lambda state: told.append(state.tracks[0].boxes), lambda: run.state.done == 2)
    assert (done.done, done.total) == (2, 6)
    assert room.counts == [1, 1, 0, 1, 1]
    assert told == [0, 2]
    room.project.history.undo(ANN)
    assert room.counts == [1, 0, 0, 0, 1]


@pytest.mark.parametrize("change", ["reject", "rename"])
def test_a_changed_reviewed_box_ends_its_run(room: Room, change: str) -> None:
    room.project.configure(classes=["person", "other"])
    uid, _ = room.accept(0, 2)
    frame, labels = room.frames[0].id, room.project.labels

    def act(state: Following) -> None:
        if state.done == 4 and change == "reject":
            labels.reject(frame, uid, room.context(0, "bob"))
        elif state.done == 4:
            labels.edit(frame, uid, room.context(0, "bob"), label="other", box=labels.get(uid).label.box)

    changed, other = room.run().run(act).tracks
    assert (changed.boxes, other.boxes) == (2, 4)
    assert [(stop.key, stop.reason) for stop in changed.stops] == [(room.frames[0].key, KEY_CHANGED)]


def test_changes_of_other_frames_do_not_stop_a_run(room: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    room.accept(0, 1)
    real, others = room.project.log.append_to_frames, iter([True, True])

    def interrupted(_: Writer, parts: Any, *rest: Any) -> object:
        """Another operator is faster, twice."""
        if next(others, False):
            new = NewLabel("person", room.truths[1][1].box)
            context = WriteContext(room.project.frames.get(parts[0].frame_id).revision, "bob")
            room.project.labels.create(parts[0].frame_id, [new], context)
        return real(parts, *rest)

    monkeypatch.setattr(Writer, "append_to_frames", interrupted)
    (track,) = room.run().run().tracks
    assert (track.boxes, track.stops) == (4, ())
    assert len(room.labels(1)) == 3


def before_storing(monkeypatch: pytest.MonkeyPatch, *actions: Callable[[], object]) -> None:
    """Lets others act after a frame's labels are read, and before its new boxes are stored; one action at a time."""
    waiting, real = chain(actions, repeat(lambda: None)), follow_run.proposal_events

    def events(*given: Any) -> object:
        made = real(*given)
        next(waiting)()
        return made

    monkeypatch.setattr(follow_run, "proposal_events", events)


def test_a_proposal_that_is_accepted_while_boxes_are_stored_stays(room: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    room.accept(0, 1)
    room.run().run()
    (uid,) = [label.uid for label in room.labels(1)]
    before_storing(monkeypatch, lambda: room.project.labels.accept(room.frames[1].id, uid, room.context(1, "bob")))
    room.run().run()
    assert [(label.uid, label.state) for label in room.labels(1)] == [(uid, ReviewState.ACCEPTED)]


def test_a_reviewed_box_that_is_deleted_while_boxes_are_stored_ends_its_object_only(
    room: Room, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second, _ = room.accept(0, tracked=False)
    labels, frame_id, new = room.project.labels, room.frames[0].id, NewLabel("person", room.truths[0][0].box)
    before_storing(
        monkeypatch,
        lambda: labels.delete(frame_id, first, room.context(0, "bob")),
        lambda: labels.create(frame_id, [new], room.context(0, "bob")),
    )
    tracks = room.run().run().tracks
    assert [track.boxes for track in tracks] == [0, 4, 4]
    assert [stop.reason for stop in tracks[0].stops] == [KEY_CHANGED], "reported once, although stored in three tries"
    assert labels.get(second).label.track_id is not None


def test_a_track_id_that_another_operator_takes_meanwhile_is_not_used(
    room: Room, monkeypatch: pytest.MonkeyPatch
) -> None:
    uid, *_ = room.accept(0, tracked=False)
    labels, other = room.project.labels, NewLabel("person", room.truths[4][1].box, track_id=1)
    # in a frame that the run does not store at that time, so that no revision tells it
    before_storing(monkeypatch, lambda: labels.create(room.frames[4].id, [other], room.context(4, "bob")))
    (track,) = room.run(uid=uid).run().tracks
    assert (track.track_id, labels.get(uid).label.track_id) == (2, 2)


@pytest.mark.parametrize("broken", [0, 2])
def test_an_unreadable_frame_is_named_where_it_stops(room: Room, monkeypatch: pytest.MonkeyPatch, broken: int) -> None:
    room.accept(0, 1)
    read, frame_id = FrameSource.read, room.frames[broken].id

    def fail(source: FrameSource, frame: StoredFrame) -> object:
        if frame.id == frame_id:
            raise FrameError(Path("depth.png"), "broken")
        return read(source, frame)

    monkeypatch.setattr(FrameSource, "read", fail)
    (track,) = room.run().run().tracks
    assert [(stop.key, stop.reason) for stop in track.stops] == [(room.frames[broken].key, "depth.png: broken")]
    assert track.boxes == max(broken - 1, 0)


def test_what_cannot_be_followed_is_refused(room: Room) -> None:
    with pytest.raises(ConfigError, match="this frame has no reviewed box to follow; accept one first"):
        room.run()
    for index in (0, 1, 4):
        (uid,) = room.accept(index, 1)
    with pytest.raises(StaleRevisionError):
        follow_from_frame(room.project, room.frames[0].id, 0, room.view, ANN)
    for match, index, forward in (
        ("this is the first frame of its recording", 0, False),
        ("this is the last frame of its recording", 4, True),
        ("the next frame has a reviewed box of this track already", 0, True),
    ):
        with pytest.raises(ConfigError, match=match):
            room.run(index, forward=forward)
    with pytest.raises(NotFoundError, match="this frame has no label nobody"):
        room.run(uid="nobody")
    room.project.labels.reject(room.frames[4].id, uid, room.context(4))
    with pytest.raises(ConfigError, match="this box is not reviewed; accept it first"):
        room.run(4, uid)
