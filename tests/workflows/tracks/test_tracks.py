"""Tracks of objects: linking, continuing into other frames, filling between key frames, carrying corrections on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from moving import ANN
from scipy.spatial.transform import Rotation
from true_room import Room

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import same_box
from annotator.project import Effort, NewLabel, Project, StoredFrame, WriteContext
from annotator.project.changes import LabelChanged
from annotator.project.classes.attributes import Attribute
from annotator.project.classes.edit import PutAttribute
from annotator.project.database.schema import recordings
from annotator.project.project import create_project
from annotator.project.records import BoxRecord
from annotator.rcv.config import RcvConfig
from annotator.tracking.smooth import FLIP, relabelled
from annotator.types import Box2D, BoxKind, Label, OrientedBox, Proposal, Quality, ReviewState, Source, Truth
from annotator.types.errors import ConfigError, FrameError, NotFoundError, StaleRevisionError
from annotator.workflows.detectors import Detectors
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.proposing.annotate import annotate
from annotator.workflows.tracks.copy_next import copy_next
from annotator.workflows.tracks.follow_run import Following
from annotator.workflows.tracks.key_frames import corrected_alike
from annotator.workflows.tracks.link import AUTHOR, link_tracks
from annotator.workflows.tracks.operations import Fill, apply
from annotator.workflows.tracks.propose_boxes import around, proposal_events, write
from annotator.workflows.tracks.refit_run import RefitRun, box_fitter
from annotator.workflows.tracks.steps import Count
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.save_object import apply_changes, copy_boxes


def put_off(box: OrientedBox, rng: np.random.Generator) -> OrientedBox:
    """The box as detected: errors of 5 % in size and two degrees in rotation, and sometimes a flipped heading."""
    turn = Rotation.from_rotvec([0.0, 0.0, 0.03 * rng.standard_normal()]).as_matrix()
    size = box.size_m * (1 + 0.05 * rng.standard_normal(3))
    found = OrientedBox.from_parts(box.center_m, box.rotation @ turn, size)
    return relabelled(found, FLIP) if rng.random() < 0.3 else found


@pytest.fixture
def owner(room: Room) -> dict[str, Truth]:
    """The true object of each of the proposals that each frame has in random order."""
    rng, owner = np.random.default_rng(5), {}
    for index, objects in enumerate(room.truths):
        # rigid objects: sizes that change over time cannot be smoothed
        pairs = zip(objects, room.truths[0], strict=True)
        rigid = [replace(each, box=OrientedBox(each.box.pose, first.box.size_m)) for each, first in pairs]
        shuffled = [rigid[int(place)] for place in rng.permutation(len(objects))]
        uids = room.propose(index, *(put_off(truth.box, rng) for truth in shuffled))
        owner |= dict(zip(uids, shuffled, strict=True))
    return owner


def test_linking_and_smoothing_improve_boxes_and_are_idempotent(room: Room, owner: dict[str, Truth]) -> None:
    project = room.project
    before = {label.uid: label.box for index in range(5) for label in room.labels(index)}

    def edit(index: int, uid: str, box: OrientedBox, track_id: int | None) -> None:
        frame = room.frames[index].id
        project.labels.edit(frame, uid, room.context(index), label="person", box=box, track_id=track_id)

    # one box is corrected, another one is also given a track
    accepted, named = (room.labels(index)[0].uid for index in (1, 3))
    for index, uid, number in ((1, accepted, None), (3, named, 40)):
        before[uid] = owner[uid].box
        edit(index, uid, owner[uid].box, number)
    done = link_tracks(project)
    assert (done.recordings, done.boxes, done.tracks, done.left, done.busy) == (1, 15, 3, 0, ())
    labels = [stored.label for stored in project.labels.select()]
    assert len({(label.track_id, owner[label.uid].track_id) for label in labels}) == 3, "one track per person"
    assert {label.track_id for label in labels} == {40, 41, 42}
    after = {label.uid: label.box for label in labels}
    assert all(np.array_equal(after[uid].rotation, before[uid].rotation) for uid in (accepted, named))
    others = [uid for uid in after if uid not in (accepted, named)]
    gain = [iou_3d(after[uid], owner[uid].box) - iou_3d(before[uid], owner[uid].box) for uid in others]
    assert np.mean(gain) > 0.02
    assert {project.labels.get(uid).label.state for uid in others} == {ReviewState.PROPOSED}
    # linking again writes nothing
    last = project.log.last()
    assert link_tracks(project).changed == 0
    assert project.log.last() == last
    # without smoothing, the original proposals are restored
    link_tracks(project, smooth=False)
    assert all(iou_3d(project.labels.get(uid).label.box, before[uid]) == pytest.approx(1) for uid in others)
    assert project.labels.get(named).label.track_id == 40
    kept = [(s.label.uid, s.label.track_id, s.track_linked, s.label.author) for s in project.labels.select()]
    project.log.rebuild()
    assert kept == [(s.label.uid, s.label.track_id, s.track_linked, s.label.author) for s in project.labels.select()]
    # a track id set by an operator applies to all boxes of the object
    stored = project.labels.get(others[0])
    edit([frame.id for frame in room.frames].index(stored.frame_id), others[0], stored.label.box, 9)
    link_tracks(project)
    person = owner[others[0]].track_id
    mine = [s.label for s in project.labels.select() if owner[s.label.uid].track_id == person]
    assert {label.track_id for label in mine} == ({9, 40} if named in {label.uid for label in mine} else {9})


def test_finalised_frames_are_linked_but_not_changed(room: Room, owner: dict[str, Truth]) -> None:
    project, (first, second) = room.project, room.frames[:2]
    project.frames.finalise(first.id, room.context(0))
    done = link_tracks(project)
    assert (done.tracks, done.left) == (3, 3)
    assert all(label.track_id is None for label in room.labels(0))
    assert [e.author for e in project.log.of_frame(first.id)] == ["rcv", ANN]
    assert [e.author for e in project.log.of_frame(second.id)] == ["rcv", AUTHOR]
    assert project.history.next(ANN)[0] == "finalise frame 1"


def fill(room: Room, track_id: int = 3, **options: Any) -> Count:
    return apply(room.project, room.recording, track_id, Fill(**options), ANN).count


def test_frames_between_boxes_are_filled_as_one_action(room: Room) -> None:
    people, frames = room.project, room.frames
    room.accept_box(0, room.box(0))
    room.accept_box(4, room.box(4))
    # frame 1 has open proposals of this person and of another one; in frame 2 the person's box is rejected
    old = room.propose(1, room.box(1), room.box(1, 1))
    (rejected,) = room.propose(2, room.box(2))
    people.labels.reject(frames[2].id, rejected, room.context(2))
    done = fill(room)
    assert (done.proposed, done.deleted, done.reviewed, done.covered) == (2, 1, 0, 1)
    new = [[label for label in room.labels(index) if label.track_id == 3] for index in range(5)]
    assert [len(labels) for labels in new] == [1, 1, 0, 1, 1]
    assert [uid in {label.uid for label in room.labels(1)} for uid in old] == [False, True]
    for n in (1, 3):
        (label,) = new[n]
        assert (label.state, label.source) == (ReviewState.PROPOSED, Source.AUTO)
        assert np.allclose(label.box.center_m, (1 - n / 4) * room.box(0).center_m + n / 4 * room.box(4).center_m)
    assert people.history.next(ANN)[0] == "propose 2 labels (frames 2 to 4)"
    people.history.undo(ANN)
    assert {label.uid for label in room.labels(1)} == set(old)
    assert room.labels(3) == []
    # only within a span
    assert fill(room, first=frames[2].id).proposed == 1
    people.history.undo(ANN)
    for n in (1, 3):
        people.frames.finalise(frames[n].id, room.context(n))
    with pytest.raises(ConfigError, match=r"unchanged: 2 in finalised frames, 1 where a box is reviewed or rejected"):
        fill(room)
    for track, match in ((5, "track 5 of people has no boxes"), (10**20, "at most 9007199254740992, not 1e\\+20")):
        with pytest.raises(ConfigError, match=match):
            fill(room, track)


def test_filled_boxes_are_fitted_in_the_background_until_it_is_stopped(room: Room) -> None:
    people, frames = room.project, room.frames
    room.accept_box(0, room.box(0))
    room.accept_box(4, room.box(4))
    done = apply(people, room.recording, 3, Fill(refit=True), ANN)
    between = {index: label for index in (1, 2, 3) for label in room.labels(index)}
    revisions = [people.frames.get(frame.id).revision for frame in frames]
    assert RefitRun(people, done, ANN, lambda _, label: label.box).run().tracks[0].boxes == 0, "none was better"
    assert [people.frames.get(frame.id).revision for frame in frames] == revisions

    def fit(frame: StoredFrame, label: Label) -> OrientedBox:
        index = [each.id for each in frames].index(frame.id)
        if index == 2:
            raise FrameError(Path(frame.key), "its image is damaged")
        if index == 3:
            # somebody accepts it meanwhile
            people.labels.accept(frame.id, label.uid, room.context(3, "bob"))
        return room.box(index)

    shown: list[Following] = []
    stopped = RefitRun(people, done, ANN, fit).run(shown.append, lambda: len(shown) == 1)
    assert (stopped.done, stopped.total, stopped.tracks[0].boxes) == (1, 3, 1)
    assert same_box(room.labels(1)[0].box, room.box(1))
    assert same_box(room.labels(2)[0].box, between[2].box), "it was stopped before"
    ended = RefitRun(people, done, ANN, fit).run()
    assert (ended.done, ended.tracks[0].boxes) == (3, 0)
    assert [stop.reason for stop in ended.tracks[0].stops] == ["000002: its image is damaged"]
    assert room.labels(3)[0].state is ReviewState.ACCEPTED
    assert same_box(room.labels(3)[0].box, between[3].box)
    people.history.undo("bob")
    # all of it is one action, which is not continued once it is undone
    people.history.undo(ANN)
    assert room.counts == [1, 0, 0, 0, 1]
    assert RefitRun(people, done, ANN, fit).run().tracks[0].boxes == 0


def test_a_batch_assigns_tracks_of_reviewed_boxes_to_proposals(room: Room, knowing: Callable[..., Detectors]) -> None:
    room.accept_box(0, room.box(0))
    room.accept_box(0, room.box(0, 1), None)
    annotate(room.project, knowing("people"), RcvConfig(), limit=2)
    found = {label.track_id: label for label in room.labels(1)}
    assert set(found) == {3, None}
    assert iou_3d(found[3].box, room.box(1)) > 0.8
    assert room.project.labels.get(found[3].uid).track_linked


def copy(room: Room, index: int, uid: str, revision: int | None = None, **options: Any) -> Any:
    at = room.context(index).revision if revision is None else revision
    return copy_next(room.project, room.frames[index].id, uid, at, ANN, **options)


def test_a_box_is_copied_to_its_predicted_position(room: Room) -> None:
    people, frames = room.project, room.frames
    room.accept_box(0, room.box(0))
    uid = room.accept_box(1, room.box(1))
    done = copy(room, 1, uid)
    (label,) = room.labels(2)
    assert (done.frame_id, [frame for frame, _ in done.changed]) == (frames[2].id, [frames[2].id])
    assert (label.track_id, label.state) == (3, ReviewState.PROPOSED)
    assert np.allclose(label.box.center_m, 2 * room.box(1).center_m - room.box(0).center_m)
    people.history.undo(ANN)
    # moved with its points, and as large as it was
    done = copy(room, 1, uid, read=FrameSource(people).read)
    (label,) = room.labels(2)
    assert (label.uid, label.state) == (done.uid, ReviewState.PROPOSED)
    assert iou_3d(label.box, room.box(2)) > 0.6
    assert np.array_equal(label.box.size_m, people.labels.get(uid).label.box.size_m)
    people.labels.accept(frames[2].id, label.uid, room.context(2))
    with pytest.raises(ConfigError, match=r"in the next frame: a reviewed box is here already$"):
        copy(room, 1, uid)
    last = room.accept_box(4, room.box(4))
    with pytest.raises(ConfigError, match="this is the last frame of its recording"):
        copy(room, 4, last)


def test_a_copied_box_without_a_track_gets_one_with_one_undo(room: Room) -> None:
    uid = room.accept_box(0, room.box(0), None)
    copy(room, 0, uid)
    assert room.project.labels.get(uid).label.track_id == room.labels(1)[0].track_id == 1
    room.project.history.undo(ANN)
    assert room.project.labels.get(uid).label.track_id is None
    assert room.labels(1) == []


@pytest.mark.parametrize("kind", BoxKind)
def test_boxes_carried_to_other_frames_enclose_what_the_reviewed_one_does(room: Room, kind: BoxKind) -> None:
    people, frames = room.project, room.frames
    for n in (0, 3):
        uid = room.accept_box(n, room.box(n), box_kind=kind)
    fill(room)
    copy(room, 3, uid)
    assert [room.labels(index)[0].box_kind for index in range(5)] == [kind] * 5
    people.history.undo(ANN)
    # the detector measures whole boxes only, so it fits no other ones
    source = FrameSource(people)
    fit = box_fitter(people, lambda frame: OpenFrame(source.read(frame)), room.view)
    off = relabelled(room.box(4), FLIP)
    off = OrientedBox.from_parts(off.center_m + 0.02, off.rotation, off.size_m)
    moved = replace(people.labels.get(uid).label, box=off)
    assert (fit(frames[4], moved) is off) == (kind is BoxKind.SILHOUETTE)
    people.history.undo(ANN)
    room.all(room.view)
    labels = [room.labels(index)[0] for index in range(5)]
    assert [label.box_kind for label in labels] == [kind] * 5
    sizes = [label.box.size_m for label in labels if label.state is ReviewState.PROPOSED]
    carried = [any(np.allclose(size, room.box(n).size_m) for n in (0, 3)) for size in sizes]
    assert all(carried) if kind is BoxKind.SILHOUETTE else not any(carried)


def test_what_cannot_be_copied_is_refused(room: Room) -> None:
    people, uid = room.project, room.accept_box(0, room.box(0), None)
    with pytest.raises(NotFoundError, match="this frame has no label gone; reload it"):
        copy(room, 0, "gone")
    with pytest.raises(StaleRevisionError):
        copy(room, 0, uid, 0)
    people.frames.finalise(room.frames[1].id, room.context(1))
    with pytest.raises(ConfigError, match="the next frame is finalised; reopen it first"):
        copy(room, 0, uid)
    with people.store.write() as connection:
        connection.execute(recordings.update().values(is_sequence=False))
    with pytest.raises(ConfigError, match="the frames of people do not follow each other in time"):
        copy(room, 0, uid)
    assert room.labels(0)[0].track_id is None
    assert link_tracks(people).unordered == ("people",)


SCHEMA: list[dict[str, Any]] = [
    {"name": "pose", "kind": "choice", "choices": ["sitting", "standing"]},
    {"name": "height", "kind": "number", "default": 1.7},
    {"name": "coat", "kind": "text", "of": "track"},
]
SITTING = {"pose": "sitting", "height": 1.5, "coat": "red"}
STANDING = {"pose": "standing", "height": 1.8, "coat": "red"}


@pytest.fixture
def valued(room: Room) -> Room:
    """The room, in a project with values of boxes and of tracks."""
    for fields in SCHEMA:
        room.project.change_classes(PutAttribute(attribute=Attribute.model_validate(fields)), ANN)
    return room


def along(room: Room, track_id: int = 3) -> list[dict[str, Any] | None]:
    """The values of a track's label in each frame."""
    by_frame = {each.frame_id: each.label for each in room.project.labels.along(1, tracks=[track_id])}
    return [dict(by_frame[frame.id].attributes) if frame.id in by_frame else None for frame in room.frames]


def test_filled_frames_have_the_values_of_the_nearer_box(valued: Room) -> None:
    valued.accept_box(0, valued.box(0), attributes=SITTING)
    valued.accept_box(4, valued.box(4), attributes=STANDING)
    fill(valued)
    # the middle frame is as near to both: the earlier one counts
    assert along(valued) == [SITTING, SITTING, SITTING, STANDING, STANDING]


def test_copied_and_followed_boxes_have_all_values(valued: Room) -> None:
    uid = valued.accept_box(0, valued.box(0), attributes=SITTING)
    copy(valued, 0, uid)
    copy_boxes(valued.project, valued.frames[2].id, valued.frames[0].id, valued.context(2))
    assert along(valued)[:3] == [SITTING] * 3
    for _ in range(2):
        valued.project.history.undo(ANN)
    valued.all(valued.view)
    found = [each for each in along(valued) if each is not None]
    assert len(found) >= 4 and found == [SITTING] * len(found)


@pytest.mark.parametrize(("given", "pose"), [({"pose": "standing"}, "standing"), ({"height": None}, "sitting")])
def test_a_copied_box_takes_over_values_that_somebody_has_set_or_removed(
    valued: Room, given: dict[str, str | None], pose: str
) -> None:
    people, second = valued.project, valued.frames[1].id
    uid = valued.accept_box(0, valued.box(0), attributes=SITTING)
    (old,) = valued.propose(1, valued.box(1))
    people.labels.set_attributes(second, old, given, valued.context(1))
    copy(valued, 0, uid)
    (copied,) = valued.labels(1)
    assert (copied.uid != old, copied.attributes["pose"]) == (True, pose)
    # the next pass leaves it alone
    valued.propose(1, valued.box(1))
    assert [label.uid for label in valued.labels(1)] == [copied.uid]


def test_linked_boxes_have_the_values_of_their_track_and_keep_their_own(valued: Room) -> None:
    people, own = valued.project, {"height": 1.7}
    valued.propose(1, valued.box(1), valued.box(1, 1))
    uid = valued.accept_box(0, valued.box(0), attributes=SITTING)
    link_tracks(people)
    assert along(valued)[1] == own | {"coat": "red"}
    # the reviewed box was another object: the proposal is now linked with that of a blue coat
    people.labels.delete(valued.frames[0].id, uid, valued.context(0))
    valued.accept_box(0, valued.box(0), 8, attributes={"pose": "sitting", "coat": "blue"})
    link_tracks(people)
    (linked,) = [each for each in along(valued, 8)[1:] if each is not None]
    assert linked == own | {"coat": "blue"}
    last = people.log.last()
    link_tracks(people)
    assert people.log.last() == last


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


@pytest.fixture
def car(tmp_path: Path) -> Iterator[Project]:
    """A project of two frames, the first of which has a reviewed car."""
    with create_project(tmp_path, "p", ["car"]) as project:
        project.recordings.add(tmp_path / "recording", "folder", "r", ["000000", "000001"], True)
        first, _ = project.frames.of()
        project.labels.create(first.id, [NewLabel("car", WAS, track_id=4)], WriteContext(0, "me"))
        yield project


WAS, NOW = (box((x, 0.0, 5.0), 0.0, (1.0, 1.0, 1.0)) for x in (0.0, 0.2))


def correct(project: Project, effort: Effort | None = None) -> None:
    """Moves the car in the first frame from `WAS` to `NOW`; the proposals after it move along."""
    first, _ = project.frames.of()
    edit = LabelChanged(uid=project.labels.of_frame(first.id)[0].uid, state=ReviewState.EDITED, box=BoxRecord.of(NOW))
    apply_changes(project, first.id, [edit], WriteContext(first.revision, "me", effort=effort), pytest.fail)


def test_who_proposed_a_corrected_box_stays_known(car: Project) -> None:
    project, (_, second) = car, car.frames.of()
    said = {"one": NewLabel("car", WAS, 0.9, 4), "two": NewLabel("car", WAS, 0.8, 4)}
    for source, label in said.items():
        project.proposals.bring(source, {second.id: [label]})
    correct(project)
    for _ in range(2):
        (stored,) = project.labels.select(states=[ReviewState.PROPOSED])
        np.testing.assert_allclose(stored.label.box.center_m, NOW.center_m)
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


def test_a_corrected_proposal_stays_the_same_one(car: Project) -> None:
    project, (_, second) = car, car.frames.of()
    trusted = Proposal("car", 0.7, WAS, Box2D("car", 1.0, 2.0, 3.0, 4.0, 0.7), (), Quality(0.1, 1.0, 0.0, 0.9, 0.4))
    new = [NewLabel("car", WAS, track_id=4, state=ReviewState.PROPOSED, proposal=trusted)]
    payloads = proposal_events(around(project, second, new), second, new)
    write(project, [(second, payloads)], "me")
    (before,) = project.labels.select(states=[ReviewState.PROPOSED])
    effort = Effort(1, 2.0)
    correct(project, effort)
    (after,) = project.labels.select(states=[ReviewState.PROPOSED])
    np.testing.assert_allclose(after.label.box.center_m, NOW.center_m)
    assert (after.label.uid, after.label.score, after.label.expected_iou_loss) == (before.label.uid, 0.7, 0.4)
    revision = project.frames.get(second.id).revision
    project.labels.accept(second.id, before.label.uid, WriteContext(revision, "me", effort=effort))
    figures = project.statistics()
    assert figures.iou_proposal_to_final == pytest.approx(iou_3d(WAS, NOW))
    assert figures.effort.actions_a_box == pytest.approx(1.0), "the correction of the one, the accepting of the other"
    project.log.rebuild()
    np.testing.assert_allclose(project.labels.get(before.label.uid).label.box.center_m, NOW.center_m)
    for _ in range(2):
        project.history.undo("me")
    (restored,) = project.labels.select(states=[ReviewState.PROPOSED])
    np.testing.assert_allclose(restored.label.box.center_m, WAS.center_m)
