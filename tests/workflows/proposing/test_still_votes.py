"""What stands still is proposed once for all frames that see it: one look and one key."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation
from sqlalchemy import func, select

from annotator.detection.perfect import PerfectDetector, Scene
from annotator.geometry.iou import iou_3d
from annotator.geometry.outline import box_on_image
from annotator.project import Project, WriteContext, create_project, new_action
from annotator.project.changes import LabelChanged
from annotator.project.classes.edit import StyleClass
from annotator.project.database.schema import sightings, stills
from annotator.project.rows import still_of
from annotator.rcv.config import RcvConfig
from annotator.rcv.first_look import known_edges
from annotator.rcv.votes import Agreed, Vote, agreed, grouped
from annotator.recordings import Recording, open_recording
from annotator.synthetic import write_generated
from annotator.types import Camera, OrientedBox, ReviewState
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.detectors import Detectors
from annotator.workflows.proposing import still_votes
from annotator.workflows.proposing.annotate import annotate
from annotator.workflows.proposing.still_votes import AUTHOR
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.tracks.link import link_tracks
from annotator.workflows.workbench.review_queue import Order, doubt, queue

FRAMES, JITTER = 8, 0.06
CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)


@pytest.fixture(scope="module")
def recording(made_once: Callable[[str, Callable[[Path], object]], Path]) -> Recording:
    """A tour of a room with exact poses, in which people walk."""
    return open_recording(
        made_once("tour", lambda path: write_generated(path / "tour", "tour", FRAMES, 0, 160, 120)) / "tour"
    )


@pytest.fixture
def tour(recording: Recording, tmp_path: Path) -> Iterator[Project]:
    with create_project(tmp_path, "p", ("object", "person")) as project:
        register_recording(project, recording)
        for name, still in (("object", True), ("person", False)):
            project.change_classes(StyleClass(name=name, style={"still": still}), "ann")
        yield project


def shaky(recording: Recording, seed: int) -> Detectors:
    """Detectors that err by some pixels on each edge."""
    frames = [recording.frame(n) for n in range(FRAMES)]
    scenes = [Scene.of(frame, load_truth(recording, n, frame)) for n, frame in enumerate(frames)]
    knowing = PerfectDetector(scenes, jitter=JITTER, seed=seed, min_points=30)
    return Detectors(knowing, knowing)


def mean_iou(project: Project, recording: Recording, boxes: Callable[[int], list[OrientedBox]]) -> float:
    """Of the boxes of objects in all frames with the nearest true ones."""
    ious = []
    for frame in project.frames.of():
        read = recording.frame(frame.index or 0)
        true = [each.box for each in load_truth(recording, frame.index or 0, read) if each.label == "object"]
        ious += [max(iou_3d(box, other) for other in true) for box in boxes(frame.id)]
    return float(np.mean(ious))


def test_one_look_takes_it_in_all_frames(tour: Project, recording: Recording) -> None:
    done = annotate(tour, shaky(recording, 0), RcvConfig())
    open_stills = tour.stills.of(1)
    assert done.still == len(open_stills) >= 4
    assert {each.state for each in open_stills} == {ReviewState.PROPOSED} and all(each.is_open for each in open_stills)
    # each waits once, in a frame that sees it; people wait in each frame
    waiting = queue(tour, Order.WORST)
    stills = [item for item in waiting.items if still_of(item.uid or "")]
    assert {still_of(item.uid or "") for item in stills} == {each.uid for each in open_stills}
    assert len(stills) == len(open_stills) and waiting.total == len(waiting.items)
    assert [item.doubt for item in waiting.items] == sorted((item.doubt or 0 for item in waiting.items), reverse=True)
    for item in stills:  # the page says as much of the box as the queue
        at = tour.labels.get(item.uid or "")
        assert doubt(at.quality, at.label.score) == pytest.approx(item.doubt)
    # better than each frame alone, and in more frames
    found = tour.proposals.found(1)
    alone = mean_iou(tour, recording, lambda id: [each.box for each in found[id] if each.label == "object"])

    def shown(frame_id: int) -> list[OrientedBox]:
        return [each.label.box for each in tour.labels.of_moment(frame_id) if each.still]

    assert mean_iou(tour, recording, shown) > alone + 0.02
    uid = stills[0].uid or ""
    context = WriteContext(tour.frames.get(stills[0].frame.id).revision, "ann")
    tour.log.append(stills[0].frame.id, [LabelChanged(uid=uid, state=ReviewState.ACCEPTED)], context)
    accepted = tour.labels.select(states=[ReviewState.ACCEPTED])
    assert {each.still for each in accepted} == {still_of(uid)} and len(accepted) >= 2
    assert queue(tour, Order.WORST).total == waiting.total - 1


def test_the_next_pass_replaces_what_is_open_and_nothing_else(tour: Project, recording: Recording) -> None:
    annotate(tour, shaky(recording, 0), RcvConfig())
    first = queue(tour, Order.TIME).items
    reviewed = [item for item in first if still_of(item.uid or "")][:2]
    for item, state in zip(reviewed, (ReviewState.ACCEPTED, ReviewState.REJECTED), strict=True):
        context = WriteContext(tour.frames.get(item.frame.id).revision, "ann")
        tour.log.append(item.frame.id, [LabelChanged(uid=item.uid or "", state=state)], context)
    before = {each.uid: each for each in tour.stills.of(1)}
    assert link_tracks(tour).busy == ()
    assert {each.uid: each.box.center_m.tolist() for each in tour.stills.of(1)} == {
        uid: each.box.center_m.tolist() for uid, each in before.items()
    }
    shown = tour.labels.count()
    annotate(tour, shaky(recording, 1), RcvConfig())
    after = {each.uid: each for each in tour.stills.of(1)}
    kept = {still_of(item.uid or "") for item in reviewed}
    assert before.keys() & after.keys() == kept
    new = [each for uid, each in after.items() if uid not in kept]
    assert len(new) >= 2
    assert all(iou_3d(each.box, after[uid or ""].box) < 0.2 for each in new for uid in kept)
    assert {each.track_id for each in new}.isdisjoint(each.track_id for each in before.values())
    shown_now = tour.labels.count()
    tour.history.undo(AUTHOR)
    assert tour.labels.count() == shown, "what was seen of the earlier ones is known"
    tour.history.redo(AUTHOR)
    assert tour.labels.count() == shown_now
    gone = select(func.count()).where(sightings.c.still.not_in(select(stills.c.uid)))
    with tour.store.read() as connection:
        assert connection.execute(gone).scalar_one() > 0
    tour.stills.forget()
    with tour.store.read() as connection:
        assert connection.execute(gone).scalar_one() == 0
    tour.history.undo(AUTHOR)
    assert tour.stills.of(1) and {each.uid for each in tour.stills.of(1)} == before.keys()
    events = list(tour.log.since())
    assert tour.log.rebuild() == len(events) and tour.problems() == []


def test_what_an_operator_decides_while_a_pass_votes_stays(
    tour: Project, recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    annotate(tour, shaky(recording, 0), RcvConfig())
    first = tour.frames.of()[0]
    item = next(each for each in queue(tour, Order.TIME).items if still_of(each.uid or ""))

    def decide(groups: list[list[Vote]]) -> list[Agreed]:
        monkeypatch.undo()
        context = WriteContext(tour.frames.get(item.frame.id).revision, "ann")
        tour.log.append(item.frame.id, [LabelChanged(uid=item.uid or "", state=ReviewState.ACCEPTED)], context)
        return agreed(groups)

    def finalise(groups: list[list[Vote]]) -> list[Agreed]:
        monkeypatch.setattr(still_votes, "agreed", decide)
        tour.frames.finalise(first.id, WriteContext(tour.frames.get(first.id).revision, "ann"))
        return agreed(groups)

    monkeypatch.setattr(still_votes, "agreed", finalise)
    assert annotate(tour, shaky(recording, 1), RcvConfig()).still >= 2
    states = {each.uid: each.state for each in tour.stills.of(1)}
    assert states[still_of(item.uid or "") or ""] is ReviewState.ACCEPTED


def test_a_pass_leaves_recordings_alone_through_which_it_does_not_go(
    tour: Project, recording: Recording, tmp_path: Path
) -> None:
    annotate(tour, shaky(recording, 0), RcvConfig())
    before = [each.uid for each in tour.stills.of(1)]
    other = open_recording(shutil.copytree(recording.path, tmp_path / "other"))
    number = register_recording(tour, other).id
    assert annotate(tour, shaky(other, 0), RcvConfig()).done == FRAMES
    assert [each.uid for each in tour.stills.of(1)] == before and tour.stills.of(number)


def test_without_a_word_on_the_class_it_takes_a_long_look(
    tour: Project, recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    tour.change_classes(StyleClass(name="object", style={"still": None}), "ann")
    assert annotate(tour, shaky(recording, 0), RcvConfig()).still == 0
    assert tour.stills.of(1) == () and tour.labels.count([ReviewState.PROPOSED]) > 0
    monkeypatch.setattr(still_votes, "LEAST_SPAN", FRAMES - 2)
    monkeypatch.setattr(still_votes, "STEADY_IOU", 1.0)
    assert still_votes.vote_stills(tour, [1], "ann", new_action()) == 0
    monkeypatch.undo()
    monkeypatch.setattr(still_votes, "LEAST_SPAN", FRAMES - 2)
    assert still_votes.vote_stills(tour, [1], "ann", new_action()) >= 2


def look_from(angle: float, box: OrientedBox, shift: np.ndarray, scale: np.ndarray, frame: int) -> Vote:
    """A vote of a camera on a circle around an upright box, whose box is moved and scaled."""
    turn = Rotation.from_euler("z", angle)
    level = Rotation.from_matrix([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    T_world_camera = RigidTransform.from_components(turn.apply([0, -3, 1.0]), turn * level)
    true = box.transformed(T_world_camera.inv())
    wrong = OrientedBox.from_parts(true.center_m + shift * true.size_m, true.rotation, true.size_m * scale)
    outline = box_on_image(CAMERA, true, "object")
    assert outline is not None
    return Vote(frame, T_world_camera, "object", wrong, 0.8, known_edges(CAMERA, outline))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_exact_image_boxes_outvote_wrong_depths(seed: int) -> None:
    """Of boxes that each frame sees too deep and too large, one comes out that none of them was as near to."""
    random = np.random.default_rng(seed)
    size = random.uniform(0.3, 0.8, 3)
    box = OrientedBox.from_parts(
        np.array([0, 0, size[2] / 2]), Rotation.from_euler("z", random.uniform(0, np.pi)).as_matrix(), size
    )
    votes = [
        look_from(angle, box, np.array([0, 0, random.uniform(0, 0.25)]), random.uniform(1.0, 1.3, 3), frame)
        for frame, angle in enumerate(np.linspace(0, 1.3, 7))
    ]
    (found,) = agreed(grouped(votes))
    alone = [iou_3d(vote.in_world, box) for vote in votes]
    assert len(found.votes) == len(votes)
    assert iou_3d(found.box, box) >= np.mean(alone)


def test_what_fills_the_image_is_no_vote_for_an_object_behind() -> None:
    """None of its edges is known, so its image box fits everything."""
    behind = OrientedBox.from_parts(np.array([0, 6, 1.0]), np.eye(3), np.ones(3))
    near = OrientedBox.from_parts(np.array([0, -1.2, 1.0]), np.eye(3), np.array([4.0, 2.0, 4.0]))
    still = np.zeros(3)
    votes = [look_from(0.02 * frame, behind, still, np.ones(3), frame) for frame in range(4)]
    last = look_from(0.0, near, still, np.ones(3), 4)
    assert last.edges == (None, None, None, None)
    (found,) = agreed(grouped([*votes, last]))
    assert list(found.votes) == votes
