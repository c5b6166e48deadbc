"""Tracks, actions over several frames, and 2D boxes on images and pseudo-views."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis.extra import numpy as npst
from store_samples import NOT_AXIS_ALIGNED, box_at, by_hand, by_machine, matrix3, proposal_at, same_box, state_of

from annotator.project import NewLabel, Project, ViewGeometry, WriteContext
from annotator.project.changes import LabelChanged, LabelDeleted, Payload, TracksLinked
from annotator.project.records import BoxRecord
from annotator.types import Box2D, BoxKind, ReviewState, Source
from annotator.types.errors import (
    FinalisedFrameError,
    HistoryError,
    ProjectError,
    StaleRevisionError,
    TrackTakenError,
)


def _track(project: Project, uid: str) -> tuple[int | None, bool]:
    stored = project.labels.get(uid)
    return stored.label.track_id, stored.track_linked


def test_track_ids_record_whether_they_come_from_linking_or_an_operator(project: Project, frame: int) -> None:
    (uid,) = project.proposals.replace(frame, [proposal_at()], by_machine(), track_ids=[4]).uids
    assert uid is not None
    assert _track(project, uid) == (4, True)
    project.labels.edit(frame, uid, by_hand(1), label="hand", box=box_at(1.0), track_id=4)
    assert _track(project, uid) == (4, True), "an edit of the box does not confirm the track"
    project.labels.edit(frame, uid, by_hand(2), label="hand", box=box_at(1.0), track_id=5)
    assert _track(project, uid) == (5, False)
    project.log.append(frame, [TracksLinked(labels=(LabelChanged(uid=uid, track_id=6),))], by_machine(3))
    assert _track(project, uid) == (6, True)
    project.log.append(frame, [LabelChanged(uid=uid, track_id=None)], by_hand(4))
    assert _track(project, uid) == (None, False)
    assert project.history.next("ann")[0] == "track hand (frame 3)"
    project.history.undo("ann")
    assert _track(project, uid) == (6, True)
    assert project.labels.get(uid).label.state is ReviewState.EDITED


def test_linking_changes_no_reviewed_box_and_no_finalised_frame(project: Project, frame: int) -> None:
    (uid,) = project.labels.create(frame, [NewLabel("hand", box_at())], by_hand()).uids
    moved = TracksLinked(labels=(LabelChanged(uid=uid, track_id=1, box=BoxRecord.of(box_at(2.0))),))
    with pytest.raises(ProjectError, match="has been reviewed"):
        project.log.append(frame, [moved], by_machine(1))
    assert same_box(project.labels.get(uid).label.box, box_at())
    project.frames.finalise(frame, by_hand(1))
    with pytest.raises(FinalisedFrameError):
        project.log.append(frame, [TracksLinked(labels=(LabelChanged(uid=uid, track_id=1),))], by_machine(2))
    # linking is automatic and cannot be undone
    assert project.history.next("ann")[0] == "finalise frame 3"


@pytest.fixture
def three(project: Project, frame: int) -> tuple[str, str, str]:
    """Uids of a frame's boxes: of track 1, of none, and a rejected one of track 1."""
    free, right, gone = (NewLabel("hand", box_at(x)) for x in (3.0, 0.0, 6.0))
    uids = project.labels.create(frame, [right, free, gone], by_hand()).uids
    project.labels.edit(frame, uids[2], by_hand(3), label="hand", box=box_at(6.0), track_id=1)
    project.labels.reject(frame, uids[2], by_hand(4))
    project.log.append(frame, [LabelChanged(uid=uids[0], track_id=1)], by_hand(5))
    return uids[0], uids[1], uids[2]


BOX = BoxRecord.of(box_at(9.0))


@pytest.mark.parametrize(
    "change",
    [
        lambda uids: LabelChanged(uid=uids[1], track_id=1),
        lambda uids: NewLabel("person", box_at(), track_id=1, state=ReviewState.PROPOSED),
        lambda uids: LabelChanged(uid=uids[2], state=ReviewState.ACCEPTED),
        lambda uids: TracksLinked(labels=(LabelChanged(uid=uids[1], track_id=1),)),
    ],
    ids=["tracked", "proposed", "a rejected one accepted", "linked"],
)
def test_no_change_gives_a_track_a_second_box_in_a_frame(
    project: Project, frame: int, three: tuple[str, str, str], change: Callable[[tuple[str, str, str]], Payload]
) -> None:
    before = state_of(project)
    with pytest.raises(TrackTakenError, match=r"frame 2 of .*: track 1 has a box in this frame already") as refused:
        project.log.append(frame, [change(three)], by_hand(6))
    assert refused.value.track_id == 1
    assert state_of(project) == before
    # the same, if the other box goes
    project.log.append(frame, [LabelDeleted(uid=three[0]), change(three)], by_hand(6))


def test_boxes_can_change_their_tracks_with_each_other(
    project: Project, frame: int, three: tuple[str, str, str]
) -> None:
    project.log.append(frame, [LabelChanged(uid=three[1], track_id=2)], by_hand(6))
    swap = [LabelChanged(uid=three[0], track_id=2), LabelChanged(uid=three[1], track_id=1)]
    project.log.append(frame, swap, by_hand(7))
    assert [_track(project, uid)[0] for uid in three] == [2, 1, 1]


def test_a_rejected_label_gives_its_track_to_one_that_was_rejected(project: Project, frame: int, three) -> None:
    right, free, gone = three
    project.log.append(frame, [LabelChanged(uid=right, track_id=2)], by_hand(6))
    back = [LabelChanged(uid=gone, track_id=2), LabelChanged(uid=gone, state=ReviewState.ACCEPTED)]
    # the same columns change as of the label that comes back, and others of the one whose track it gets
    as_well = [LabelChanged(uid=free, track_id=5), LabelChanged(uid=free, state=ReviewState.REJECTED)]
    project.log.append(frame, [*as_well, LabelChanged(uid=right, state=ReviewState.REJECTED), *back], by_hand(7))
    assert [_track(project, uid)[0] for uid in three] == [2, 5, 2]
    project.history.undo("ann")
    assert [_track(project, uid)[0] for uid in three] == [2, None, 1]


def test_an_undo_that_would_give_a_track_a_second_box_is_refused_and_can_be_skipped(
    project: Project, frame: int, three: tuple[str, str, str]
) -> None:
    project.labels.create(frame, [NewLabel("person", box_at(12.0))], by_hand(6))
    project.labels.reject(frame, three[0], by_hand(7))
    project.log.append(frame, [LabelChanged(uid=three[1], track_id=1)], by_hand(8, "bob"))
    before = state_of(project)
    with pytest.raises(HistoryError, match="track 1 has a box in this frame already") as refused:
        project.history.undo("ann")
    assert refused.value.frame_id == frame
    assert state_of(project) == before
    # the one before is undone
    assert project.history.undo("ann", skip=True).words == "draw person (frame 3)"


def test_a_pass_gives_a_track_once_and_not_that_of_a_reviewed_box(project: Project, frame: int) -> None:
    states = (ReviewState.ACCEPTED, ReviewState.REJECTED)
    made = [NewLabel("hand", box_at(9.0 * n), track_id=n, state=state) for n, state in enumerate(states)]
    project.labels.create(frame, made, by_hand())
    found = [proposal_at(x) for x in (0.0, 3.0, 6.0, 12.0, 15.0)]
    uids = project.proposals.replace(frame, found, by_machine(2), track_ids=[4, 4, 4, 0, 1]).uids
    # the first one is covered
    assert uids[0] is None
    assert [_track(project, uid) for uid in uids if uid] == [(4, True), (None, False), (None, False), (1, True)]


@pytest.mark.parametrize("is_ours", [True, False], ids=["ours has the track", "a reviewed box has it"])
def test_boxes_of_other_software_get_no_track_of_another_box(project: Project, frame: int, is_ours: bool) -> None:
    def theirs() -> dict[float, int | None]:
        boxes = [NewLabel("hand", box_at(x), 0.3, 4) for x in (6.0, 9.0)]
        project.proposals.bring("lidar", {frame: boxes})
        return {label.box.center_m[0]: label.track_id for label in project.labels.of_frame(frame)}

    assert theirs() == {6.0: 4, 9.0: None}, "the second box of its track has none"
    change = (by_machine if is_ours else by_hand)(project.frames.get(frame).revision)
    if is_ours:
        project.proposals.replace(frame, [proposal_at()], change, track_ids=[4])
    else:
        project.proposals.bring("lidar", {frame: []})
        change = by_hand(project.frames.get(frame).revision)
        project.labels.create(frame, [NewLabel("hand", box_at(), track_id=4)], change)
    assert list(theirs().values()).count(4) == 1


HANDS = (Box2D("hand", 1.5, 2.0, 3.0, 4.0), Box2D("hand", -3.0, 0.0, 100.25, 1 / 3, 0.5))


@pytest.fixture
def view(project: Project) -> str:
    return project.views.store(np.full((12, 16, 3), 7, np.uint8))


def test_setting_boxes_on_an_image_replaces_the_earlier_ones(project: Project, frame: int) -> None:
    assert project.boxes.on_image(frame) is None
    for count, kind, source in ((2, BoxKind.SILHOUETTE, Source.MANUAL), (0, BoxKind.BOX, Source.IMPORTED)):
        change = WriteContext(project.frames.get(frame).revision, "ann", source)
        project.boxes.set_on_image(frame, HANDS[:count], kind, change)
        boxes = project.boxes.on_image(frame)
        assert boxes is not None, "an image without boxes is labelled, too"
        assert (boxes.boxes, boxes.box_kind, boxes.source, boxes.author) == (HANDS[:count], kind, source, "ann")
    first = project.frames.of()[0].id
    project.boxes.set_on_image(first, HANDS, BoxKind.BOX, by_hand())
    assert [entry.frame_id for entry in project.boxes.on_images()] == [first, frame], "in the order of the frames"
    assert project.boxes.frames_with_images() == {first, frame}


def test_boxes_on_a_view_raise_the_revision_of_its_frame(project: Project, frame: int, view: str) -> None:
    geometry = ViewGeometry(axes=matrix3(NOT_AXIS_ALIGNED), metres_per_px=0.001, origin_m=(-0.5, 1 / 3))
    receipt = project.boxes.set_on_view(view, HANDS, BoxKind.BOX, by_hand(), frame_id=frame, step=1, geometry=geometry)
    assert receipt.revision == project.frames.get(frame).revision == 1
    (boxes,) = project.boxes.on_views_of(frame)
    assert (boxes.view_id, boxes.frame_id, boxes.boxes, boxes.step) == (view, frame, HANDS, 1)
    assert boxes.geometry == geometry
    assert project.boxes.on_views() == (boxes,)
    project.boxes.set_on_view(view, [], BoxKind.BOX, by_hand(1), frame_id=frame)
    (boxes,) = project.boxes.on_views_of(frame)
    assert (boxes.boxes, boxes.step, boxes.geometry) == ((), None, None)
    assert project.boxes.on_views() == (boxes,)


def test_a_view_without_a_frame_has_its_own_revision(project: Project, frame: int, view: str) -> None:
    assert project.boxes.set_on_view(view, HANDS, BoxKind.BOX, by_hand()).revision == 1
    with pytest.raises(StaleRevisionError, match="view "):
        project.boxes.set_on_view(view, [], BoxKind.BOX, by_hand())
    project.boxes.set_on_view(view, HANDS[:1], BoxKind.SILHOUETTE, by_hand(1))
    (boxes,) = project.boxes.on_views()
    assert (boxes.frame_id, boxes.revision, boxes.boxes, boxes.box_kind) == (None, 2, HANDS[:1], BoxKind.SILHOUETTE)
    # the same image may be a view of a frame, too
    project.boxes.set_on_view(view, HANDS, BoxKind.BOX, by_hand(), frame_id=frame)
    assert [(boxes.frame_id, len(boxes.boxes)) for boxes in project.boxes.on_views()] == [(None, 1), (frame, 2)]


def test_boxes_on_a_view_need_its_image(project: Project, frame: int) -> None:
    with pytest.raises(ProjectError, match="the image is missing"):
        project.boxes.set_on_view("0" * 64, HANDS, BoxKind.BOX, by_hand(), frame_id=frame)
    assert project.boxes.on_views() == ()


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(rgb=npst.arrays(np.uint8, npst.array_shapes(min_dims=2, max_dims=2, max_side=9).map(lambda s: (*s, 3))))
def test_an_image_is_read_back(project: Project, rgb: np.ndarray) -> None:
    assert np.array_equal(project.views.load(project.views.store(rgb)), rgb)


def test_the_id_is_the_hash_and_an_image_is_stored_once(project: Project) -> None:
    rgb = np.arange(4 * 5 * 3, dtype=np.uint8).reshape(4, 5, 3)
    view = project.views.store(rgb)
    content = project.views.path(view).read_bytes()
    assert view == hashlib.sha256(content).hexdigest()
    assert project.views.store(content) == project.views.store(rgb.copy()) == view
    assert [path.name for path in project.views.folder.iterdir()] == [f"{view}.png"]


def test_a_damaged_image_and_what_is_none_are_refused(project: Project) -> None:
    view = project.views.store(np.zeros((4, 4, 3), np.uint8))
    path = project.views.path(view)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(ProjectError, match=r"\.png: is damaged"):
        project.views.load(view)
    with pytest.raises(ProjectError, match="only PNG"):
        project.views.store(b"\xff\xd8\xff jpeg")
    undecodable = project.views.store(b"\x89PNG\r\n\x1a\n and then nonsense")
    with pytest.raises(ProjectError, match="cannot be decoded as an image"):
        project.views.load(undecodable)


@pytest.mark.parametrize("view", ["", "../project", "0" * 63, "A" * 64])
def test_an_invalid_view_id_is_refused(project: Project, view: str) -> None:
    with pytest.raises(ProjectError, match="not the id of a view"):
        project.views.load(view)
