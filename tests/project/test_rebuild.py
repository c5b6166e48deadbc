"""The tables are those that the audit gives, and an undo gives the state before; two operators work in any order."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule
from sqlalchemy import text
from store_samples import (
    STEPS,
    Step,
    actions,
    box_at,
    by_hand,
    by_machine,
    content,
    give_attributes,
    proposal_at,
    some_boxes,
    sorted_state,
    state_of,
)

from annotator.project import Project, create_project
from annotator.project.audit.events import as_one
from annotator.project.changes import ImageBoxesSet, LabelCreated, LinkedLabel, TracksLinked
from annotator.project.records import BoxRecord
from annotator.types import BoxKind, Label, ReviewState
from annotator.types.errors import ConfigError, HistoryError, ProjectError

KINDS = (*STEPS, "loose view", "link", "adjust", "values", "frame values", "classes")
KEYS = ["0", "1", "2"]
SMALL = st.integers(0, 3)
PEOPLE = st.sampled_from(["ann", "bob"])
STEP = st.tuples(st.sampled_from(KINDS), st.integers(0, 2), SMALL, SMALL)


def linked(labels: Sequence[Label], track_id: int) -> TracksLinked:
    """Links all labels of a frame and moves the boxes of open proposals."""
    moved = BoxRecord.of(box_at(4.0))
    return TracksLinked(
        labels=tuple(
            LinkedLabel(uid=each.uid, track_id=track_id, box=moved if each.state is ReviewState.PROPOSED else None)
            for each in labels
        )
    )


class TwoOperators(RuleBasedStateMachine):
    """Edits of two operators, passes, imports, class changes, undo and redo, in any order."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        root = Path(self.folder.name)
        self.project = create_project(root, "p", ("hand", "person"))
        self.project.recordings.add(root / "r", "rgbd", "r", KEYS, True)
        self.views = [self.project.views.store(np.full((2, 2, 3), n, np.uint8)) for n in range(2)]
        self.is_removed = False
        give_attributes(self.project)
        for frame in self.project.frames.of():
            self.project.proposals.replace(frame.id, [proposal_at(0.0), proposal_at(5.0, "person")], by_machine())

    @rule(steps=st.lists(st.tuples(PEOPLE, STEP), min_size=4, max_size=10))
    def act(self, steps: list[tuple[str, Step]]) -> None:
        if self.is_removed:
            self.remove_or_bring_back()
        for who, step in steps:
            self._act(who, step)

    def _act(self, who: str, step: Step) -> None:
        """What is refused changes nothing; an action is undone and redone exactly."""
        project, before, last = self.project, content(self.project), self.project.log.last()
        try:
            self._take(who, step)
        except (ProjectError, ConfigError):
            assert content(project) == before
            return
        events = [event for event in project.log.since(last) if event.action is not None and event.author == who]
        if as_one(row for event in events for row in event.rows):
            after = content(project)
            project.history.undo(who)
            assert content(project) == before
            project.history.redo(who)
            assert content(project) == after

    def _take(self, who: str, step: Step) -> None:
        what, place, a, b = step
        project, frame, view = self.project, self.project.frames.of()[place], self.views[b % 2]
        loose = [seen.revision for seen in project.boxes.on_views() if (seen.frame_id, seen.view_id) == (None, view)]
        more = {
            "loose view": lambda: project.boxes.set_on_view(
                view, some_boxes(a), BoxKind.BOX, by_hand(max(loose, default=0), who)
            ),
            "link": lambda: project.log.append(
                frame.id, [linked(project.labels.of_frame(frame.id), a)], by_machine(frame.revision)
            ),
        }
        (actions(project, self.views, step, who) | more)[what]()

    @rule(who=PEOPLE, is_undo=st.booleans(), skip=st.booleans())
    def step(self, who: str, is_undo: bool, skip: bool) -> None:
        """A refused step changes nothing."""
        before = content(self.project)
        try:
            (self.project.history.undo if is_undo else self.project.history.redo)(who, skip=skip)
        except HistoryError:
            assert content(self.project) == before

    @rule()
    def remove_or_bring_back(self) -> None:
        """A removed recording has nothing to show, and comes back as it was."""
        before = sorted_state(self.project)
        if self.is_removed:
            self.project.recordings.rescan(1, KEYS)
        else:
            self.project.recordings.remove(1, "ann")
            assert (self.project.labels.select(), self.project.boxes.on_images(), self.project.frames.of()) == ((),) * 3
            self.project.recordings.rescan(1, KEYS)
            assert sorted_state(self.project) == before
            self.project.recordings.remove(1, "ann")
        self.is_removed = not self.is_removed

    @rule()
    def replay(self) -> None:
        """The tables are those that the audit gives, and stay so."""
        before, events = state_of(self.project), list(self.project.log.since())
        assert self.project.log.rebuild() == len(events)
        assert state_of(self.project) == before
        assert list(self.project.log.since()) == events

    def teardown(self) -> None:
        self.replay()
        assert self.project.problems() == []
        self.project.close()
        self.folder.cleanup()


TestTwoOperators = TwoOperators.TestCase
TestTwoOperators.settings = settings(
    max_examples=8, stateful_step_count=8, suppress_health_check=[HealthCheck.too_slow]
)


def test_a_rebuild_repairs_corrupted_tables(project: Project, frame: int) -> None:
    uids = project.proposals.replace(frame, [proposal_at(0.0), proposal_at(5.0)], by_machine()).uids
    project.labels.accept(frame, uids[0], by_hand(1))
    before = state_of(project)
    with project.store.write() as connection:
        connection.execute(text("UPDATE labels SET state = 'rejected', frame_id = 1"))
        connection.execute(text("UPDATE frames SET finalised = 1"))
    assert state_of(project) != before
    assert project.log.rebuild() == 2
    assert state_of(project) == before


def test_a_write_of_several_changes_names_the_event_of_each(project: Project, frame: int) -> None:
    drawn = ImageBoxesSet(boxes=tuple(some_boxes(1)), box_kind=BoxKind.BOX)
    made = LabelCreated(uid="u", label="hand", box=BoxRecord.of(box_at()))
    receipt = project.log.append(frame, [drawn, made], by_hand())
    boxes, before = project.boxes.on_image(frame), state_of(project)
    assert boxes is not None and boxes.event_id == receipt.event_ids[0]
    project.log.rebuild()
    assert state_of(project) == before


def test_a_long_log_is_replayed_in_batches(project: Project, frame: int) -> None:
    for revision in range(60):
        project.boxes.set_on_image(frame, some_boxes(revision % 3), BoxKind.BOX, by_hand(revision))
    assert [event.revision for event in project.log.since()] == list(range(1, 61))
    before = state_of(project)
    assert project.log.rebuild() == 60
    assert state_of(project) == before
