"""Tracks of objects: linking, continuing into other frames, filling between key frames, carrying corrections on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from threading import Lock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import iou_3d
from annotator.project import Effort, NewLabel, Project, StoredFrame, WriteContext
from annotator.project.classes.attributes import Attribute, AttributeKind
from annotator.project.classes.edit import put_attribute
from annotator.project.database.schema import recordings
from annotator.project.project import create_project
from annotator.rcv.config import RcvConfig
from annotator.tracking.smooth import FLIP, relabelled
from annotator.types import Box2D, BoxKind, OrientedBox, Proposal, Quality, ReviewState, Source, Truth
from annotator.types.errors import ConfigError, NotFoundError, StaleRevisionError
from annotator.workflows.detectors import Detectors
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.proposing.annotate import annotate
from annotator.workflows.tracks.copy_next import carry_correction, copy_next, corrected_alike
from annotator.workflows.tracks.follow_run import follow_recording
from annotator.workflows.tracks.interpolate import box_fitter, interpolate, interpolate_back
from annotator.workflows.tracks.link import AUTHOR, link_tracks
from annotator.workflows.tracks.propose_boxes import NewProposal, proposal_events, seeds_of, write
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.loaded_detectors import ReadyDetector

ANN = "ann"


def by_hand(project: Project, frame: StoredFrame) -> WriteContext:
    return WriteContext(project.frames.get(frame.id).revision, ANN)


def by_machine(project: Project, frame: StoredFrame) -> WriteContext:
    return WriteContext(project.frames.get(frame.id).revision, "rcv", Source.AUTO)


def proposal(box: OrientedBox, label: str = "person") -> Proposal:
    return Proposal(label, 0.8, box, Box2D(label, 0.0, 0.0, 9.0, 9.0), (), Quality(0.1, 0.9, 0.01))


def put_off(box: OrientedBox, rng: np.random.Generator) -> OrientedBox:
    """The box as detected: errors of 5 % in size and two degrees in rotation, and sometimes a flipped heading."""
    turn = Rotation.from_rotvec([0.0, 0.0, 0.03 * rng.standard_normal()]).as_matrix()
    size = box.size_m * (1 + 0.05 * rng.standard_normal(3))
    found = OrientedBox.from_parts(box.center_m, box.rotation @ turn, size)
    return relabelled(found, FLIP) if rng.random() < 0.3 else found


@pytest.fixture
def proposed(people: Project, truths: list[list[Truth]]) -> tuple[Project, dict[str, Truth]]:
    """Proposals in each frame in random order, and the true object of each label."""
    rng, owner = np.random.default_rng(5), {}
    for frame, objects in zip(people.frames.of(), truths, strict=True):
        # rigid objects: sizes that change over time cannot be smoothed
        rigid = [replace(o, box=OrientedBox(o.box.pose, r.box.size_m)) for o, r in zip(objects, truths[0], strict=True)]
        shuffled = [rigid[int(place)] for place in rng.permutation(len(objects))]
        found = [proposal(put_off(truth.box, rng)) for truth in shuffled]
        uids = people.proposals.replace(frame.id, found, by_machine(people, frame)).uids
        owner |= {uid: truth for uid, truth in zip(uids, shuffled, strict=True) if uid is not None}
    return people, owner


def test_linking_and_smoothing_improve_boxes_and_are_idempotent(proposed: tuple[Project, dict[str, Truth]]) -> None:
    project, owner = proposed
    frames = project.frames.of()
    before = {label.uid: label.box for frame in frames for label in project.labels.of_frame(frame.id)}
    # one box is corrected, another one is also given a track
    accepted, named = (project.labels.of_frame(frames[n].id)[0] for n in (1, 3))
    for frame, label, number in ((frames[1], accepted, None), (frames[3], named, 40)):
        before[label.uid] = owner[label.uid].box
        edit = {"label": "person", "box": owner[label.uid].box, "track_id": number}
        project.labels.edit(frame.id, label.uid, by_hand(project, frame), **edit)
    done = link_tracks(project)
    assert (done.recordings, done.boxes, done.tracks, done.left, done.busy) == (1, 15, 3, 0, ())
    labels = project.labels.select()
    ids = {(stored.label.track_id, owner[stored.label.uid].track_id) for stored in labels}
    assert len(ids) == 3, "one track per person"
    assert {stored.label.track_id for stored in labels} == {40, 41, 42}
    after = {stored.label.uid: stored.label.box for stored in labels}
    untouched = (accepted.uid, named.uid)
    assert all(np.array_equal(after[uid].rotation, before[uid].rotation) for uid in untouched)
    others = [uid for uid in after if uid not in untouched]
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
    assert project.labels.get(named.uid).label.track_id == 40
    kept = [(s.label.uid, s.label.track_id, s.track_linked, s.label.author) for s in project.labels.select()]
    project.log.rebuild()
    assert kept == [(s.label.uid, s.label.track_id, s.track_linked, s.label.author) for s in project.labels.select()]
    # a track id set by an operator applies to all boxes of the object
    uid = others[0]
    stored = project.labels.get(uid)
    frame = project.frames.get(stored.frame_id)
    edit = {"label": "person", "box": stored.label.box, "track_id": 9}
    project.labels.edit(frame.id, uid, by_hand(project, frame), **edit)
    link_tracks(project)
    mine = [s.label for s in project.labels.select() if owner[s.label.uid].track_id == owner[uid].track_id]
    given = {9, 40} if named.uid in {label.uid for label in mine} else {9}
    assert {label.track_id for label in mine} == given


def test_finalised_frames_are_linked_but_not_changed(
    proposed: tuple[Project, dict[str, Truth]],
) -> None:
    project = proposed[0]
    frames = project.frames.of()
    project.frames.finalise(frames[0].id, by_hand(project, frames[0]))
    done = link_tracks(project)
    assert (done.tracks, done.left) == (3, 3)
    assert all(label.track_id is None for label in project.labels.of_frame(frames[0].id))
    assert [e.author for e in project.log.of_frame(frames[0].id)] == ["rcv", ANN]
    assert [e.author for e in project.log.of_frame(frames[1].id)] == ["rcv", AUTHOR]
    assert project.history.next(ANN)[0] == "finalise frame 000000"


def accept_truth(project: Project, frame: StoredFrame, truths: list[Truth], track_id: int | None = 3) -> list[str]:
    """Creates accepted labels of true boxes, the first one with a track id."""
    new = [NewLabel("person", truth.box, track_id=None if place else track_id) for place, truth in enumerate(truths)]
    return list(project.labels.create(frame.id, new, by_hand(project, frame)).uids)


def test_seeds_are_the_reviewed_boxes_of_the_previous_frame(people: Project, truths: list[list[Truth]]) -> None:
    frames = people.frames.of()
    uids = accept_truth(people, frames[1], truths[1])
    people.labels.reject(frames[1].id, uids[1], by_hand(people, frames[1]))
    assert [seed.label for seed in seeds_of(people, frames[2])] == ["person", "person"]
    assert iou_3d(seeds_of(people, frames[2])[1].box, truths[1][2].box) == pytest.approx(1)
    assert seeds_of(people, frames[1]) == seeds_of(people, frames[0]) == ()


def test_frames_between_key_frames_are_filled_as_one_action(people: Project, truths: list[list[Truth]]) -> None:
    frames = people.frames.of()
    first, last = (accept_truth(people, frames[n], truths[n][:1])[0] for n in (0, 4))
    # frame 1 has open proposals of this person and of another one; in frame 2 the person's box is rejected
    there, other = (proposal(truth.box) for truth in truths[1][:2])
    old = people.proposals.replace(frames[1].id, [there, other], by_machine(people, frames[1])).uids
    (rejected,) = people.proposals.replace(
        frames[2].id, [proposal(truths[2][0].box)], by_machine(people, frames[2])
    ).uids
    assert rejected is not None
    people.labels.reject(frames[2].id, rejected, by_hand(people, frames[2]))
    recording = people.recordings.all()[0].id
    done = interpolate(people, recording, 3, ANN)
    assert ([frame for frame, _ in done.filled], done.covered) == ([frames[1].id, frames[3].id], 1)
    new = {frame.id: [label for label in people.labels.of_frame(frame.id) if label.track_id == 3] for frame in frames}
    assert [len(new[frame.id]) for frame in frames] == [1, 1, 0, 1, 1]
    assert old[0] not in {label.uid for label in people.labels.of_frame(frames[1].id)}
    assert old[1] in {label.uid for label in people.labels.of_frame(frames[1].id)}
    for n in (1, 3):
        (label,) = new[frames[n].id]
        assert (label.state, label.source) == (ReviewState.PROPOSED, Source.AUTO)
        expected = (1 - n / 4) * truths[0][0].box.center_m + n / 4 * truths[4][0].box.center_m
        assert np.allclose(label.box.center_m, expected)
    assert people.history.next(ANN)[0] == "propose 2 labels (frames 000001 to 000003)"
    people.history.undo(ANN)
    assert {label.uid for label in people.labels.of_frame(frames[1].id)} == set(old)
    assert people.labels.of_frame(frames[3].id) == ()
    # as requested by the page, back from the current box
    back = interpolate_back(people, frames[4].id, last, people.frames.get(frames[4].id).revision, ANN)
    assert back.filled
    with pytest.raises(StaleRevisionError):
        interpolate_back(people, frames[4].id, last, 0, ANN)
    with pytest.raises(ConfigError, match="no reviewed box in an earlier frame"):
        interpolate_back(people, frames[0].id, first, people.frames.get(frames[0].id).revision, ANN)
    for n in (1, 3):
        people.frames.finalise(frames[n].id, by_hand(people, frames[n]))
    with pytest.raises(ConfigError, match=r"no frame to fill .*\(2 finalised, 1 reviewed or rejected\)"):
        interpolate(people, recording, 3, ANN)
    with pytest.raises(ConfigError, match="track 5 has 0 reviewed boxes"):
        interpolate(people, recording, 5, ANN)
    with pytest.raises(ConfigError, match="track ids are at most 9007199254740992, not 1e\\+20"):
        interpolate(people, recording, 10**20, ANN)
    with pytest.raises(ConfigError, match="frame 000001 has no reviewed box of track 3"):
        interpolate(people, recording, 3, ANN, first="000001")


def test_a_batch_assigns_tracks_of_reviewed_boxes_to_proposals(
    people: Project, truths: list[list[Truth]], knowing: Callable[..., Detectors]
) -> None:
    frames = people.frames.of()
    accept_truth(people, frames[0], truths[0][:2])
    annotate(people, knowing("people"), RcvConfig(), limit=2)
    found = {label.track_id: label for label in people.labels.of_frame(frames[1].id)}
    assert set(found) == {3, None}
    assert iou_3d(found[3].box, truths[1][0].box) > 0.8
    assert people.labels.get(found[3].uid).track_linked


def test_a_box_is_copied_to_its_predicted_position(people: Project, truths: list[list[Truth]]) -> None:
    frames = people.frames.of()
    _, (uid,) = [accept_truth(people, frames[n], truths[n][:1]) for n in (0, 1)]
    done = copy_next(people, frames[1].id, uid, 1, ANN)
    (label,) = people.labels.of_frame(frames[2].id)
    assert (done.frame_id, [frame for frame, _ in done.changed]) == (frames[2].id, [frames[2].id])
    assert (label.track_id, label.state) == (3, ReviewState.PROPOSED)
    assert np.allclose(label.box.center_m, 2 * truths[1][0].box.center_m - truths[0][0].box.center_m)
    people.history.undo(ANN)
    # moved with its points, and as large as it was
    read = FrameSource(people).read
    done = copy_next(people, frames[1].id, uid, people.frames.get(frames[1].id).revision, ANN, read=read)
    (label,) = people.labels.of_frame(frames[2].id)
    assert (label.uid, label.state) == (done.uid, ReviewState.PROPOSED)
    assert iou_3d(label.box, truths[2][0].box) > 0.8
    assert np.array_equal(label.box.size_m, people.labels.get(uid).label.box.size_m)
    with pytest.raises(ConfigError, match=r"in frame 000002: a reviewed box is here already$"):
        people.labels.accept(frames[2].id, label.uid, by_hand(people, people.frames.get(frames[2].id)))
        copy_next(people, frames[1].id, uid, people.frames.get(frames[1].id).revision, ANN)
    (last,) = accept_truth(people, frames[4], truths[4][:1])
    with pytest.raises(ConfigError, match="last of its recording"):
        copy_next(people, frames[4].id, last, 1, ANN)


def test_a_copied_box_takes_over_values_that_somebody_has_set(people: Project, truths: list[list[Truth]]) -> None:
    pose = Attribute(name="pose", kind=AttributeKind.TEXT)
    people.change_classes(lambda config: put_attribute(config, pose), ANN)
    first, second = people.frames.of()[:2]
    (uid,) = accept_truth(people, first, truths[0][:1])
    found = [proposal(truths[1][0].box)]
    (old,) = people.proposals.replace(second.id, found, by_machine(people, second)).uids
    assert old is not None
    people.labels.set_attributes(second.id, old, {"pose": "lying"}, by_hand(people, second))
    copy_next(people, first.id, uid, people.frames.get(first.id).revision, ANN)
    (copied,) = people.labels.of_frame(second.id)
    assert (copied.uid != old, copied.attributes) == (True, {"pose": "lying"})
    # the next pass leaves it alone
    assert people.proposals.replace(second.id, found, by_machine(people, second)).covered == 1
    assert [label.uid for label in people.labels.of_frame(second.id)] == [copied.uid]


def test_a_copied_box_without_a_track_gets_one_with_one_undo(people: Project, truths: list[list[Truth]]) -> None:
    frames = people.frames.of()
    (uid,) = accept_truth(people, frames[0], truths[0][:1], track_id=None)
    copy_next(people, frames[0].id, uid, 1, ANN)
    assert people.labels.get(uid).label.track_id == people.labels.of_frame(frames[1].id)[0].track_id == 1
    people.history.undo(ANN)
    assert people.labels.get(uid).label.track_id is None
    assert people.labels.of_frame(frames[1].id) == ()


@pytest.mark.parametrize("kind", BoxKind)
def test_boxes_carried_to_other_frames_enclose_what_the_reviewed_one_does(
    people: Project, truths: list[list[Truth]], knowing: Callable[..., Detectors], kind: BoxKind
) -> None:
    frames, view = people.frames.of(), knowing("people").view
    for n in (0, 3):
        new = NewLabel("person", truths[n][0].box, track_id=3, box_kind=kind)
        (uid,) = people.labels.create(frames[n].id, [new], by_hand(people, frames[n])).uids
    interpolate(people, people.recordings.all()[0].id, 3, ANN)
    copy_next(people, frames[3].id, uid, people.frames.get(frames[3].id).revision, ANN)
    assert [people.labels.of_frame(frame.id)[0].box_kind for frame in frames] == [kind] * 5
    people.history.undo(ANN)
    # the detector measures whole boxes only, so it fits no other ones
    source, ready = FrameSource(people), ReadyDetector(view, BoxKind.BOX, Lock())
    fit = box_fitter(people, lambda frame: OpenFrame(source.read(frame)), ready)
    moved, label = people.frames.get(frames[4].id), people.labels.get(uid).label
    off = relabelled(truths[4][0].box, FLIP)
    off = OrientedBox.from_parts(off.center_m + 0.02, off.rotation, off.size_m)
    assert (fit(moved, off, label) is off) == (kind is BoxKind.SILHOUETTE)
    people.history.undo(ANN)
    follow_recording(people, people.recordings.all()[0].id, ReadyDetector(view, BoxKind.BOX, Lock()), ANN)
    labels = [people.labels.of_frame(frame.id)[0] for frame in frames]
    assert [label.box_kind for label in labels] == [kind] * 5
    sizes = [label.box.size_m for label in labels if label.state is ReviewState.PROPOSED]
    reviewed = [truths[n][0].box.size_m for n in (0, 3)]
    carried = [any(np.allclose(size, each) for each in reviewed) for size in sizes]
    assert all(carried) if kind is BoxKind.SILHOUETTE else not any(carried)


def test_what_cannot_be_copied_is_refused(people: Project, truths: list[list[Truth]]) -> None:
    frames = people.frames.of()
    (uid,) = accept_truth(people, frames[0], truths[0][:1], track_id=None)
    with pytest.raises(NotFoundError, match="has no label gone; reload the frame"):
        copy_next(people, frames[0].id, "gone", 1, ANN)
    with pytest.raises(StaleRevisionError):
        copy_next(people, frames[0].id, uid, 0, ANN)
    people.frames.finalise(frames[1].id, by_hand(people, frames[1]))
    with pytest.raises(ConfigError, match="frame 000001 is finalised; reopen it first"):
        copy_next(people, frames[0].id, uid, 1, ANN)


def test_recordings_without_a_time_order_have_no_next_frame(people: Project, truths: list[list[Truth]]) -> None:
    frames = people.frames.of()
    (uid,) = accept_truth(people, frames[0], truths[0][:1], track_id=None)
    with people.store.write() as connection:
        connection.execute(recordings.update().values(is_sequence=False))
    with pytest.raises(ConfigError, match="the frames of people do not follow each other in time"):
        copy_next(people, frames[0].id, uid, 1, ANN)
    assert people.labels.of_frame(frames[0].id)[0].track_id is None
    assert people.labels.of_frame(frames[1].id) == ()
    assert link_tracks(people).unordered == ("people",)


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
    write(project, [(second, payloads)], "me")
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
