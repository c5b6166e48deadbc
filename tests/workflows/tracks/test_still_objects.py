"""Objects that stand still: one box in the world, which each frame that sees it shows, edited anywhere."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from annotator.geometry.iou import iou_3d
from annotator.project import NewLabel, Project, WriteContext, create_project
from annotator.project.changes import LabelChanged, LabelDeleted
from annotator.project.classes.edit import StyleClass
from annotator.project.records import BoxRecord
from annotator.recordings import Recording, open_recording
from annotator.synthetic import write_generated
from annotator.types import Label, OrientedBox, ReviewState, Truth
from annotator.types.errors import ConfigError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.exporting import ExportFormat, export_project
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.tracks.operations import Delete, Fill, SetClass, SetNumber, apply
from annotator.workflows.tracks.still_objects import Move, StandStill, candidates, find_sightings

ANN, FRAMES, STILL = "ann", 8, 3
AHEAD = np.array([1.0, 0.0, 0.0])
PROPOSED, ACCEPTED = ReviewState.PROPOSED, ReviewState.ACCEPTED


@pytest.fixture(scope="module")
def recording(made_once: Callable[[str, Callable[[Path], object]], Path]) -> Recording:
    """A tour of a room with exact poses."""
    return open_recording(
        made_once("tour", lambda path: write_generated(path / "tour", "tour", FRAMES, 0, 160, 120)) / "tour"
    )


@pytest.fixture(scope="module")
def truth(recording: Recording) -> list[Truth]:
    """An object that stands in sight of all frames."""
    every = [load_truth(recording, n, recording.frame(n)) for n in range(FRAMES)]
    of_track = [[each for each in truths if each.track_id == STILL] for truths in every]
    return [one for (one,) in of_track]


class Tour:
    def __init__(self, project: Project, truth: list[Truth]) -> None:
        self.project, self.truth = project, truth
        self.frames = project.frames.of()

    def put(self, index: int, state: ReviewState = ACCEPTED, shift_m: float = 0.0, track_id: int = STILL) -> str:
        true = self.truth[index].box
        box = OrientedBox.from_parts(true.center_m + shift_m * AHEAD, true.rotation, true.size_m)
        new = NewLabel("object", box, track_id=track_id, state=state)
        return self.project.labels.create(self.frames[index].id, [new], self.context(index)).uids[0]

    def context(self, index: int) -> WriteContext:
        return WriteContext(self.project.frames.get(self.frames[index].id).revision, ANN)

    def change(self, index: int, *payloads: LabelChanged | LabelDeleted) -> None:
        self.project.log.append(self.frames[index].id, payloads, self.context(index))

    def shown(self) -> list[Label | None]:
        """The box of the track in each frame."""
        found = {each.frame_id: each.label for each in self.project.labels.along(1, tracks=[STILL])}
        return [found.get(frame.id) for frame in self.frames]

    def ious(self) -> list[float]:
        """With the truth, in each frame."""
        return [0.0 if a is None else iou_3d(a.box, b.box) for a, b in zip(self.shown(), self.truth, strict=True)]


@pytest.fixture
def tour(recording: Recording, truth: list[Truth], tmp_path: Path) -> Tour:
    project = create_project(tmp_path, "p", ("object", "person", "sofa"))
    register_recording(project, recording)
    return Tour(project, truth)


def test_one_look_labels_all_frames_that_see_it(tour: Tour) -> None:
    tour.put(0)
    assert tour.shown()[1:] == [None] * (FRAMES - 1)
    apply(tour.project, 1, STILL, StandStill(), ANN)
    assert [label is not None for label in tour.shown()] == [True] + [False] * (FRAMES - 1), "not looked for yet"
    looked = list[int]()
    # where an operator has had a box of it, nothing is to be looked for
    near, left = tour.frames[5].id, FRAMES - 1
    assert find_sightings(tour.project, 1, near=near, progress=lambda done, _: looked.append(done)) == left
    assert looked == list(range(FRAMES))
    assert min(tour.ious()) > 0.999
    assert {label.state for label in tour.shown() if label} == {ACCEPTED}
    assert tour.project.statistics().labels.by_state[ACCEPTED] == FRAMES == tour.project.labels.count()
    assert find_sightings(tour.project, 1) == 0, "all was looked for"


def test_an_edit_anywhere_is_one_everywhere_but_a_frame_may_differ(tour: Tour) -> None:
    tour.put(0)
    apply(tour.project, 1, STILL, StandStill(), ANN)
    find_sightings(tour.project, 1)
    before, events = tour.shown(), tour.project.log.last()
    assert all(before)
    at_4 = before[4]
    assert at_4 is not None
    moved = OrientedBox.from_parts(at_4.box.center_m + 0.3 * AHEAD, at_4.box.rotation, at_4.box.size_m)
    tour.change(4, LabelChanged(uid=at_4.uid, state=ReviewState.EDITED, box=BoxRecord.of(moved)))
    assert len(list(tour.project.log.since(events))) == 1
    apart = [
        np.linalg.norm(a.box.center_m - b.box.center_m) for a, b in zip(tour.shown(), before, strict=True) if a and b
    ]
    assert apart == pytest.approx([0.3] * FRAMES)
    assert tour.project.stills.unsighted(1), "it is looked for again where it is now"
    tour.project.history.undo(ANN)
    assert tour.ious() == pytest.approx([1.0] * FRAMES, abs=1e-3)
    assert not tour.project.stills.unsighted(1)
    # only in frame 2, and not visible in frame 3
    uids = [label.uid if label else "" for label in tour.shown()]
    tour.change(2, LabelChanged(uid=uids[2], state=ReviewState.EDITED, box=BoxRecord.of(moved), here=True))
    tour.change(3, LabelDeleted(uid=uids[3], here=True))
    states = [label.state if label else None for label in tour.shown()]
    assert states == [ACCEPTED, ACCEPTED, ReviewState.EDITED, ReviewState.REJECTED, *[ACCEPTED] * 4]
    own = tour.shown()[2]
    assert own is not None
    tour.change(2, LabelDeleted(uid=own.uid))
    assert tour.ious()[2] > 0.999, "without its own box, the frame shows the object's"


def test_what_becomes_of_other_boxes_is_counted_first(tour: Tour) -> None:
    for index, (state, shift_m) in enumerate([(ACCEPTED, 0.0), (PROPOSED, 0.4), (ACCEPTED, 0.01), (ACCEPTED, 1.0)]):
        tour.put(index, state, shift_m)
    counted = apply(tour.project, 1, STILL, StandStill(), ANN, dry_run=True).count
    does, _, unchanged = counted.words().partition("; ")
    assert does == "changes 1 box and deletes 2 boxes, 2 of them reviewed"
    assert unchanged == "unchanged: 1 where a box is reviewed or rejected already"
    assert tour.project.stills.of(1) == ()
    before = tour.shown()
    assert apply(tour.project, 1, STILL, StandStill(), ANN).count == counted
    assert [label is not None for label in tour.shown()] == [True, False, True, True, *[False] * 4]
    find_sightings(tour.project, 1)
    assert [iou > 0.999 for iou in tour.ious()] == [True, True, True, False, *[True] * 4]
    with pytest.raises(ConfigError, match="stands still already"):
        apply(tour.project, 1, STILL, StandStill(), ANN)
    tour.project.history.undo(ANN)
    assert [label and label.uid for label in tour.shown()] == [label and label.uid for label in before]


def test_a_track_that_moves_after_all_has_proposals(tour: Tour) -> None:
    tour.put(0)
    apply(tour.project, 1, STILL, StandStill(), ANN)
    find_sightings(tour.project, 1)
    before = tour.ious()
    counted = apply(tour.project, 1, STILL, Move(frame=tour.frames[2].id), ANN).count
    assert (counted.changed, counted.proposed) == (1, FRAMES - 1)
    states = [label.state if label else None for label in tour.shown()]
    assert states == [PROPOSED] * 2 + [ACCEPTED] + [PROPOSED] * 5
    assert tour.ious() == pytest.approx(before)
    assert tour.project.stills.of(1) == ()
    tour.project.history.undo(ANN)
    assert len(tour.project.stills.of(1)) == 1
    assert tour.ious() == pytest.approx(before)


def test_what_was_rejected_neither_comes_back_nor_keeps_its_number(tour: Tour) -> None:
    tour.put(0)
    apply(tour.project, 1, STILL, StandStill(), ANN)
    find_sightings(tour.project, 1)
    (shown, *_) = tour.shown()
    assert shown is not None
    tour.change(0, LabelChanged(uid=shown.uid, state=ReviewState.REJECTED))
    with pytest.raises(ConfigError, match="does not stand still"):
        apply(tour.project, 1, STILL, Move(), ANN)
    assert tour.project.labels.count([PROPOSED]) == 0
    tour.put(3)
    assert apply(tour.project, 1, STILL, StandStill(), ANN).count.changed == 1
    find_sightings(tour.project, 1)
    assert tour.project.labels.count([ACCEPTED]) == FRAMES


def test_whole_track_operations_take_it_as_one_box(tour: Tour) -> None:
    tour.put(0)
    apply(tour.project, 1, STILL, StandStill(), ANN)
    find_sightings(tour.project, 1)
    assert apply(tour.project, 1, STILL, SetClass(label="sofa"), ANN).count.changed == 1
    assert {label.label for label in tour.shown() if label} == {"sofa"}
    for operation in (SetNumber(), Fill(), Delete(first=tour.frames[3].id)):
        with pytest.raises(ConfigError, match="has one box in all frames"):
            apply(tour.project, 1, STILL, operation, ANN)
    assert apply(tour.project, 1, STILL, Delete(), ANN).count.deleted == 1
    assert tour.shown() == [None] * FRAMES


def test_tracks_that_may_stand_still_are_named(tour: Tour) -> None:
    for index in (0, 6):
        tour.put(index)
        tour.put(index, shift_m=float(index), track_id=20)
    assert list(candidates(tour.project, 1)) == [STILL]
    tour.project.change_classes(StyleClass(name="object", style={"still": True}), ANN)
    assert tour.project.config.class_styles["object"].still is True
    assert candidates(tour.project, 1) == dict.fromkeys((STILL, 20), "object stands still")


def test_an_export_has_it_in_every_frame(tour: Tour, tmp_path: Path) -> None:
    tour.put(0)
    apply(tour.project, 1, STILL, StandStill(), ANN)
    find_sightings(tour.project, 1)
    export_project(tour.project, tmp_path / "out", ExportFormat.KITTI)
    files = sorted((tmp_path / "out").rglob("label_2/*.txt"))
    assert [len(file.read_text().splitlines()) for file in files] == [1] * FRAMES


def test_without_poses_nothing_stands_still(people: Project) -> None:
    frame = people.frames.of()[0]
    new = NewLabel("person", OrientedBox.from_parts(np.array([0.0, 0.0, 3.0]), np.eye(3), np.ones(3)), track_id=1)
    people.labels.create(frame.id, [new], WriteContext(frame.revision, ANN))
    with pytest.raises(ConfigError, match="does not say where its camera was"):
        apply(people, 1, 1, StandStill(), ANN)
