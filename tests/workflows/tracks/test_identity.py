"""Whatever is done in whatever order: a track has one box in a frame, and reviewed boxes stay as they are.

Random sequences of what an operator, a pass and an import can do with tracks. After each step:

- no track has two boxes in a frame;
- what was reviewed has the same box and class, and at most got a track, unless this step was about it (linking may
  change ids that linking gave);
- no box was proposed at the place of a reviewed one of its class;
- undo gives the state before the step, redo the one after it.
"""

from __future__ import annotations

import itertools
import shutil
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from moving import ANN, FRAMES, Walking, box_of, proposal_of, tracks_of

from annotator.project import NewLabel, Project, WriteContext, open_project
from annotator.project.changes import LabelChanged, LabelDeleted, Payload
from annotator.project.records import BoxRecord
from annotator.tracking.link import overlap_at_place
from annotator.types import Label, OrientedBox, ReviewState, Source
from annotator.types.errors import AnnotatorError, HistoryError, TrackTakenError
from annotator.workflows.importing.boxes_3d import create_if_unlabelled, with_tracks_once
from annotator.workflows.tracks.copy_next import copy_next
from annotator.workflows.tracks.follow_run import follow_from_frame, follow_recording
from annotator.workflows.tracks.link import link_tracks
from annotator.workflows.tracks.operations import Delete, Fill, Merge, Operation, SetClass, SetNumber, SetSize, apply
from annotator.workflows.tracks.refit_run import RefitRun
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.save_object import apply_changes, copy_boxes

INDEX, PERSON = st.integers(0, FRAMES - 1), st.integers(0, 1)
TRACK = st.sampled_from([None, 1, 2, 3])
OFF_M = st.sampled_from([0.0, 0.1, 0.25])
CLASS = st.sampled_from(["person", "chair"])
FOUND = st.lists(st.tuples(PERSON, TRACK, CLASS), max_size=3)
# A label: the n-th of a frame.
NTH = st.tuples(INDEX, st.integers(0, 3))
SPAN = (
    st.lists(INDEX, min_size=2, max_size=2)
    .map(sorted)
    .flatmap(lambda ends: st.sampled_from([(None, None), (ends[0], None), (None, ends[1]), tuple(ends)]))
)
OPERATIONS = [
    SPAN.flatmap(
        lambda ends, kind=kind, given=given: st.builds(kind, first=st.just(ends[0]), last=st.just(ends[1]), **given)
    )
    for kind, given in (
        (SetClass, {"label": CLASS}),
        (SetNumber, {"number": TRACK}),
        (Merge, {"number": TRACK}),
        (SetSize, {"size_m": st.sampled_from([(0.6, 0.5, 1.7), (0.9, 0.5, 1.2)])}),
        (Delete, {}),
        (Fill, {"refit": st.booleans()}),
    )
]
STEP = st.one_of(
    st.tuples(st.just("label"), INDEX, PERSON, TRACK, OFF_M, CLASS),
    st.tuples(st.just("follow"), INDEX, st.booleans()),
    st.tuples(st.just("follow one"), NTH, st.booleans()),
    st.tuples(st.just("follow all"), st.sampled_from([(True, False), (False, True), (True, True)])),
    st.tuples(st.just("copy"), INDEX),
    st.tuples(st.just("copy next"), NTH),
    *(st.tuples(st.just("operate"), st.sampled_from([1, 2]), operation) for operation in OPERATIONS),
    st.tuples(st.just("correct"), NTH, st.sampled_from([0.1, 0.4])),
    st.tuples(st.just("track"), NTH, TRACK),
    st.tuples(st.just("merge"), NTH, TRACK, st.booleans()),
    st.tuples(st.just("decide"), NTH, st.sampled_from([ReviewState.ACCEPTED, ReviewState.REJECTED, None])),
    st.tuples(st.just("link")),
    st.tuples(st.just("pass"), INDEX, FOUND),
    st.tuples(st.just("import"), INDEX, FOUND, st.booleans()),
    st.tuples(st.just("undo")),
)
# The state of each person's box in each frame at the start.
START = st.lists(
    st.sampled_from([None, ReviewState.PROPOSED, ReviewState.ACCEPTED]), min_size=2 * FRAMES, max_size=2 * FRAMES
)
WALKING = st.builds(
    Walking,
    drift_m=st.sampled_from([0.0, 0.05, 0.15]),
    lost=st.sets(st.tuples(PERSON, INDEX), max_size=2),
    taken_for=st.dictionaries(st.tuples(PERSON, INDEX), PERSON, max_size=2),
)
# Steps about certain labels, which may change these.
ABOUT = {"track", "merge", "decide", "undo", "operate", "correct"}
# Steps that are no action: they cannot be undone.
PASSES = {"link", "pass", "import", "undo"}
PROPOSING = {"follow", "follow one", "follow all", "copy", "copy next", "operate", "correct"}


class Room:
    """A project, and what can be done in it."""

    def __init__(self, project: Project, walking: Walking) -> None:
        self.project, self.walking = project, walking
        self.frames = [frame.id for frame in project.frames.of()]
        self.recording = project.recordings.all()[0].id

    def labels(self) -> dict[str, tuple[int, Label]]:
        """Each label by its uid, with its frame."""
        return {stored.label.uid: (stored.frame_id, stored.label) for stored in self.project.labels.select()}

    def state(self) -> set[tuple[object, ...]]:
        """All that matters of all labels."""
        return {
            (frame, uid, label.label, label.state, label.track_id, label.box.pose.tobytes(), label.box.size_m.tobytes())
            for uid, (frame, label) in self.labels().items()
        }

    def context(self, index: int, author: str = ANN, source: Source = Source.MANUAL) -> WriteContext:
        return WriteContext(self.project.frames.get(self.frames[index]).revision, author, source)

    def begin(self, start: list[ReviewState | None]) -> None:
        """Gives the people tracks, in part reviewed, in part a little off."""
        for place, state in enumerate(start):
            index, person = divmod(place, 2)
            if state is not None:
                box = box_of(person, index, 0.0 if state is ReviewState.ACCEPTED else 0.05)
                new = [NewLabel("person", box, track_id=person + 1, state=state)]
                self.project.labels.create(self.frames[index], new, self.context(index))

    def do(self, kind: str, *given: Any) -> None:
        getattr(self, f"do_{kind.replace(' ', '_')}")(*given)

    def nth(self, at: tuple[int, int]) -> Label:
        labels = self.project.labels.of_frame(self.frames[at[0]])
        if not labels:
            raise HistoryError("there is no label")
        return labels[at[1] % len(labels)]

    def do_label(self, index: int, person: int, track: int | None, off_m: float, name: str) -> None:
        self.change(index, NewLabel(name, box_of(person, index, off_m), track_id=track))

    def change(self, index: int, *payloads: Payload) -> None:
        """As the page does; boxes of the track of a corrected one may move along."""
        apply_changes(self.project, self.frames[index], payloads, self.context(index), unexpected)

    def do_follow(self, index: int, forward: bool) -> None:
        self._follow(index, None, forward)

    def do_follow_one(self, at: tuple[int, int], forward: bool) -> None:
        self._follow(at[0], self.nth(at).uid, forward)

    def _follow(self, index: int, uid: str | None, forward: bool) -> None:
        revision = self.project.frames.get(self.frames[index]).revision
        with self.walking.followed():
            follow_from_frame(self.project, self.frames[index], revision, None, ANN, uid=uid, forward=forward).run()

    def do_follow_all(self, directions: tuple[bool, bool]) -> None:
        forward, backward = directions
        with self.walking.followed():
            follow_recording(self.project, self.recording, None, ANN, forward=forward, backward=backward)

    def do_copy(self, index: int) -> None:
        copy_boxes(self.project, self.frames[index], None, self.context(index))

    def do_copy_next(self, at: tuple[int, int]) -> None:
        copy_next(self.project, self.frames[at[0]], self.nth(at).uid, self.context(at[0]).revision, ANN)

    def do_operate(self, track: int, operation: Operation) -> None:
        """Reviewed boxes change only as the count has said."""
        ends = {name: getattr(operation, name) for name in ("first", "last")}
        ids = {name: None if end is None else self.frames[end] for name, end in ends.items()}
        inside = set(self.frames[slice(ends["first"], None if ends["last"] is None else ends["last"] + 1)])
        operation, before = operation.model_copy(update=ids), self.labels()
        told = apply(self.project, self.recording, track, operation, ANN, dry_run=True).count
        assert self.labels().keys() == before.keys(), "it was only counted"
        done = apply(self.project, self.recording, track, operation, ANN, told=told)
        assert done.count == told
        if isinstance(operation, Fill) and operation.refit:
            RefitRun(self.project, done, ANN, lambda _, label: shifted(label.box, 0.1)).run()
        after = self.labels()
        changed = {
            uid
            for uid, (_, was) in before.items()
            if is_reviewed(was)
            and not (uid in after and is_same(was, after[uid][1]) and after[uid][1].track_id == was.track_id)
        }
        assert len(changed) == told.reviewed
        involved = {track, told.number}
        assert all(before[uid][0] in inside and before[uid][1].track_id in involved for uid in changed)

    def do_correct(self, at: tuple[int, int], by_m: float) -> None:
        """Reviewed boxes stay, also those of the track."""
        label = self.nth(at)
        edit = LabelChanged(uid=label.uid, state=ReviewState.EDITED, box=BoxRecord.of(shifted(label.box, by_m)))
        before = self.labels()
        self.change(at[0], edit)
        others = {uid: each for uid, each in before.items() if uid != label.uid}
        require_reviewed_untouched(others, self.labels(), is_linked=False)

    def do_track(self, at: tuple[int, int], track: int | None) -> None:
        self.change(at[0], LabelChanged(uid=self.nth(at).uid, track_id=track))

    def do_merge(self, at: tuple[int, int], track: int | None, keeps_this: bool) -> None:
        """As the page does when a track is taken: one of the two boxes is deleted."""
        try:
            self.do_track(at, track)
        except TrackTakenError as error:
            uid, frame = self.nth(at).uid, self.frames[at[0]]
            (other,) = (
                label
                for label in self.project.labels.of_frame(frame)
                if label.track_id == error.track_id and label.state is not ReviewState.REJECTED and label.uid != uid
            )
            tracked = LabelChanged(uid=uid, track_id=track)
            self.change(at[0], *([LabelDeleted(uid=other.uid), tracked] if keeps_this else [LabelDeleted(uid=uid)]))

    def do_decide(self, at: tuple[int, int], state: ReviewState | None) -> None:
        uid = self.nth(at).uid
        self.change(at[0], LabelDeleted(uid=uid) if state is None else LabelChanged(uid=uid, state=state))

    def do_link(self) -> None:
        link_tracks(self.project)

    def do_pass(self, index: int, found: list[tuple[int, int | None, str]]) -> None:
        proposals = [proposal_of(box_of(person, index), name) for person, _, name in found]
        context = self.context(index, "rcv", Source.AUTO)
        tracks = [track for _, track, _ in found]
        self.project.proposals.replace(self.frames[index], proposals, context, track_ids=tracks)

    def do_import(self, index: int, found: list[tuple[int, int | None, str]], as_labels: bool) -> None:
        boxes = [NewLabel(name, box_of(person, index, 0.05), 0.6, track) for person, track, name in found]
        if as_labels:
            create_if_unlabelled(self.project, self.frames[index], with_tracks_once(boxes)[0], "import")
        else:
            self.project.proposals.bring("lidar", {self.frames[index]: boxes})

    def do_undo(self) -> None:
        self.project.history.undo(ANN)


def shifted(box: OrientedBox, by_m: float) -> OrientedBox:
    return OrientedBox.from_parts(box.center_m + np.array([by_m, 0.0, 0.0]), box.rotation, box.size_m)


def unexpected() -> OpenFrame:
    raise AssertionError("no frame has to be read")


def is_same(was: Label, now: Label) -> bool:
    """Whether a label has the same box and class."""
    boxes = [label.box.pose.tobytes() + label.box.size_m.tobytes() for label in (was, now)]
    return boxes[0] == boxes[1] and was.label == now.label


def is_on_track(label: Label) -> bool:
    return label.track_id is not None and label.state is not ReviewState.REJECTED


def is_reviewed(label: Label) -> bool:
    return label.state in (ReviewState.ACCEPTED, ReviewState.EDITED)


def require_reviewed_untouched(
    before: dict[str, tuple[int, Label]], after: dict[str, tuple[int, Label]], is_linked: bool
) -> None:
    for uid, (_, was) in before.items():
        if is_reviewed(was):
            now = after[uid][1]
            assert is_same(was, now) and now.state is was.state
            assert is_linked or now.track_id == was.track_id or was.track_id is None


def require_nothing_covered(before: dict[str, tuple[int, Label]], after: dict[str, tuple[int, Label]]) -> None:
    """No open proposal that is new, or has another box or class, is at the place of a reviewed box of its class."""
    new = [
        (frame, label)
        for uid, (frame, label) in after.items()
        if label.state is ReviewState.PROPOSED and (uid not in before or not is_same(before[uid][1], label))
    ]
    for (frame, label), (there, other) in itertools.product(new, before.values()):
        if frame == there and is_reviewed(other) and label.label == other.label:
            assert not overlap_at_place([label.box], [other.box]).any()


@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(WALKING, START, st.lists(STEP, min_size=8, max_size=16))
def test_a_track_has_one_box_in_a_frame_and_reviewed_boxes_stay(
    empty: Path, tmp_path: Path, walking: Walking, start: list[ReviewState | None], steps: list[tuple[Any, ...]]
) -> None:
    shutil.rmtree(tmp_path / "room", ignore_errors=True)
    shutil.copytree(empty, tmp_path / "room")
    with closing(open_project(tmp_path / "room")) as project:
        room = Room(project, walking)
        room.begin(start)
        for kind, *arguments in steps:
            labels, state = room.labels(), room.state()
            try:
                room.do(kind, *arguments)
            except AnnotatorError:
                assert kind != "link", "linking never contradicts itself"
                assert room.state() == state, "what is refused changes nothing"
                continue
            tracks = [(frame, label.track_id) for frame, label in room.labels().values() if is_on_track(label)]
            assert len(tracks) == len(set(tracks))
            if kind not in ABOUT:
                require_reviewed_untouched(labels, room.labels(), kind == "link")
            if kind in PROPOSING:
                require_nothing_covered(labels, room.labels())
            after = room.state()
            if kind not in PASSES and after != state:
                project.history.undo(ANN)
                assert room.state() == state
                project.history.redo(ANN)
                assert room.state() == after


def test_linking_never_gives_an_object_the_given_id_of_another(empty: Path) -> None:
    with closing(open_project(empty)) as project:
        room = Room(project, Walking())
        room.do_label(0, 0, 2, 0.0, "person")
        room.do_label(1, 1, 2, 0.0, "chair")
        room.do_pass(2, [(0, None, "person"), (1, None, "chair")])
        for _ in range(2):
            link_tracks(project)
            assert tracks_of(project) == ["2", "2", "3? 4?", "", ""]
