"""A camera that turns and drives: what stands still, or moves evenly, in the world does so in what is predicted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from moving import ANN, proposal_of
from scipy.spatial.transform import RigidTransform, Rotation
from true_room import Room

from annotator.geometry.oriented_box import same_box
from annotator.project import NewLabel
from annotator.project.changes import LabelChanged
from annotator.project.records import BoxRecord
from annotator.rcv.config import RcvConfig
from annotator.rcv.follow_object import Followed
from annotator.recordings.poses import between
from annotator.types import OrientedBox, ReviewState
from annotator.workflows.checking.project_labels import check_project
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.tracks import follow_objects
from annotator.workflows.tracks.copy_next import copy_next
from annotator.workflows.tracks.follow_objects import Follower
from annotator.workflows.tracks.link import link_tracks
from annotator.workflows.tracks.operations import Fill, Merge, apply
from annotator.workflows.tracks.propose_boxes import seeds_of
from annotator.workflows.tracks.timeline import Moment, Timeline
from annotator.workflows.workbench.save_object import apply_changes

OPEN, ACCEPTED = ReviewState.PROPOSED, ReviewState.ACCEPTED
TRACK, SIZE_M = 3, np.array([4.2, 1.8, 1.5])
AHEAD = np.array([1.0, 0.0, 0.0])


class Drive:
    """The room's five frames, from random places in map coordinates; and a van there that stands or drives evenly."""

    def __init__(self, room: Room, seed: int, step_m: float = 0.0, missing: int | None = None) -> None:
        random = np.random.default_rng(seed)
        origin = np.array([5e5, 5.8e6, 30.0])
        rotations = Rotation.random(5, rng=random)
        places = [origin + random.normal(0, 8, 3) for _ in range(5)]
        self.room = room
        self.T_world_camera = [RigidTransform.from_components(*each) for each in zip(places, rotations, strict=True)]
        keys = [frame.key for frame in room.frames]
        poses = {key: T for n, (key, T) in enumerate(zip(keys, self.T_world_camera, strict=True)) if n != missing}
        room.project.recordings.rescan(room.recording, keys, poses=poses)
        turn = Rotation.random(rng=random).as_matrix()
        self.world = [OrientedBox.from_parts(origin + n * step_m * AHEAD, turn, SIZE_M) for n in range(5)]

    def van(self, index: int) -> OrientedBox:
        """The van in a camera frame."""
        return self.world[index].transformed(self.T_world_camera[index].inv())

    def put(self, index: int, state: ReviewState = ACCEPTED, track_id: int | None = TRACK) -> str:
        new = NewLabel("person", self.van(index), track_id=track_id, state=state)
        return self.room.project.labels.create(self.room.frames[index].id, [new], self.room.context(index)).uids[0]

    def boxes(self) -> dict[int, OrientedBox]:
        """The track's boxes in the world."""
        places = {frame.id: index for index, frame in enumerate(self.room.frames)}
        along = self.room.project.labels.along(self.room.recording, tracks=[TRACK])
        here = [(places[each.frame_id], each.label.box) for each in along]
        return {index: box.transformed(self.T_world_camera[index]) for index, box in here}

    def assert_as_in_the_world(self, count: int) -> None:
        boxes = self.boxes()
        assert len(boxes) == count
        for index, box in boxes.items():
            np.testing.assert_allclose(box.pose, self.world[index].pose, atol=1e-7)


@pytest.mark.parametrize(("seed", "step_m"), [(0, 0.0), (1, 0.0), (2, 1.5), (3, -0.7)])
def test_a_gap_is_filled_in_the_world(room: Room, seed: int, step_m: float) -> None:
    drive = Drive(room, seed, step_m)
    for index in (0, 4):
        drive.put(index)
    assert apply(room.project, room.recording, TRACK, Fill(), ANN).count.proposed == 3
    drive.assert_as_in_the_world(5)


@pytest.mark.parametrize("missing", [1, 4])
def test_a_frame_without_a_pose_is_between_those_beside_it(room: Room, missing: int) -> None:
    drive = Drive(room, 0, missing=missing)
    first, *_, last = [each for n, each in enumerate(drive.T_world_camera[:3]) if n != missing]
    T = between(first, last, 0.5) if missing == 1 else drive.T_world_camera[3]
    assert T is not None
    drive.T_world_camera[missing] = T
    read = Timeline(room.project, room.recording).moment(missing).frame.T_world_camera
    assert read is not None
    np.testing.assert_allclose(read.as_matrix(), T.as_matrix(), atol=1e-7)
    for index in (0, 4):
        drive.put(index)
    apply(room.project, room.recording, TRACK, Fill(), ANN)
    drive.assert_as_in_the_world(5)


@pytest.mark.parametrize("step_m", [0.0, 0.5])
def test_a_box_is_copied_and_seeded_as_it_moves_in_the_world(room: Room, step_m: float) -> None:
    drive = Drive(room, 4, step_m)
    for index in (0, 1, 2):
        uid = drive.put(index)
    frame = room.frames[2]
    copy_next(room.project, frame.id, uid, frame.revision, ANN)
    drive.assert_as_in_the_world(4)
    (seed,) = seeds_of(room.project, room.frames[3])
    stands = drive.world[2].transformed(drive.T_world_camera[3].inv())
    np.testing.assert_allclose(seed.box.pose, stands.pose, atol=1e-7)


def test_open_boxes_move_with_a_corrected_one_by_as_much_in_the_world(room: Room) -> None:
    drive = Drive(room, 5)
    uids = [drive.put(index, state) for index, state in enumerate((ACCEPTED, OPEN, OPEN, OPEN, ACCEPTED))]
    up = np.array([0.0, 0.0, 0.4])
    wanted = drive.world[2]
    now = OrientedBox.from_parts(wanted.center_m + up, wanted.rotation, SIZE_M)
    edit = LabelChanged(
        uid=uids[2], state=ReviewState.EDITED, box=BoxRecord.of(now.transformed(drive.T_world_camera[2].inv()))
    )
    assert apply_changes(room.project, room.frames[2].id, [edit], room.context(2), pytest.fail) == 2
    risen = [drive.boxes()[n].center_m - drive.world[n].center_m for n in range(5)]
    np.testing.assert_allclose(risen, np.outer([0, 0.5, 1, 0.5, 0], up), atol=1e-7)


def test_a_track_is_linked_through_the_turns_of_the_camera_and_keeps_its_front(room: Room) -> None:
    """By the camera, the boxes are many lengths apart."""
    drive = Drive(room, 6, step_m=1.5)
    for index in range(5):
        room.propose(index, drive.van(index))
    link_tracks(room.project)
    (track_id,) = {label.track_id for index in range(5) for label in room.labels(index)}
    assert track_id is not None
    frames = {frame.id: index for index, frame in enumerate(room.frames)}
    for each in room.project.labels.along(room.recording):
        np.testing.assert_allclose(each.label.box.pose, drive.van(frames[each.frame_id]).pose, atol=1e-7)


def test_the_likeliest_other_part_of_a_track_is_where_it_would_be_in_the_world(room: Room) -> None:
    drive = Drive(room, 7)
    for index in (0, 1):
        drive.put(index)
    for index in (3, 4):
        drive.put(index, track_id=8)
    # as the camera sees it, this one has not moved
    same = NewLabel("person", drive.van(1), track_id=9)
    room.project.labels.create(room.frames[3].id, [same], room.context(3))
    assert apply(room.project, room.recording, TRACK, Merge(), ANN).count.number == 8


@pytest.mark.parametrize(
    ("step_m", "away", "wanted"),
    [
        (1.2, None, []),
        (-1.2, None, [("heading", 0, "track 3 moves 4.8 m against its heading from here on")]),
        # it stands still, but for noise
        (-0.1, None, []),
        # one box is elsewhere: there it goes, and from there it comes
        (
            0.0,
            2,
            [("track", 2, "track 3 jumps by 9.0 m since frame 000001"), ("track", 3, "jumps by 9.0 m since frame")],
        ),
    ],
)
def test_a_track_that_moves_backwards_or_jumps_in_the_world_is_found(
    room: Room, step_m: float, away: int | None, wanted: list[tuple[str, int, str]]
) -> None:
    drive = Drive(room, 9)
    for index in range(5):
        ahead = drive.world[0].rotation @ AHEAD * (index * step_m + 9.0 * (index == away))
        drive.world[index] = OrientedBox.from_parts(drive.world[0].center_m + ahead, drive.world[0].rotation, SIZE_M)
        drive.put(index)
    places = {frame.id: index for index, frame in enumerate(room.frames)}
    moves = [each for each in check_project(room.project).warnings if each.kind in ("heading", "track")]
    found = [(each.kind, places[each.frame], each.message) for each in moves]
    assert [each[:2] for each in found] == [each[:2] for each in wanted]
    assert all(text in told for (_, _, told), (_, _, text) in zip(found, wanted, strict=True))


def test_following_expects_what_moves_evenly_in_the_world(room: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    drive, guesses = Drive(room, 8, step_m=1.2), list[OrientedBox]()

    def find(frame: object, guess: OrientedBox, *_: object) -> Followed:
        guesses.append(guess)
        return Followed(proposal_of(drive.van(len(guesses))), kept=1.0)

    source = FrameSource(room.project)
    frames = [
        replace(source.read(frame), T_world_camera=T)
        for frame, T in zip(room.frames, drive.T_world_camera, strict=True)
    ]
    monkeypatch.setattr(follow_objects, "follow_object", find)
    moments = [Moment(n, frame, float(n)) for n, frame in enumerate(frames)]
    follower = Follower(moments[0], drive.van(0), "person", None, lambda _: RcvConfig())
    for each in moments[1:]:
        follower.step(each)
    # of the first step the motion is not known
    assert not same_box(guesses[0], drive.van(1))
    for index, guess in enumerate(guesses[1:], start=2):
        np.testing.assert_allclose(guess.pose, drive.van(index).pose, atol=1e-7)
