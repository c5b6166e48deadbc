"""The tables are those that the audit gives, and an undo gives the state before; two operators work in any order.

One moment of the project has two cameras.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule
from scipy.spatial.transform import RigidTransform, Rotation
from sqlalchemy import text
from store_samples import (
    STEPS,
    Step,
    actions,
    box_at,
    by_hand,
    by_machine,
    give_attributes,
    proposal_at,
    same_box,
    some_boxes,
    sorted_state,
    state_of,
)

from annotator.project import (
    FramePart,
    NewLabel,
    Project,
    RunShare,
    WriteContext,
    create_project,
    new_action,
    open_project,
)
from annotator.project.audit.events import as_one
from annotator.project.changes import LabelChanged, Payload, StillMade, StillProposal, StillsProposed, TracksLinked
from annotator.project.database.schema import AUDITED, columns_of
from annotator.project.recordings import SharedCloud
from annotator.project.records import BoxRecord
from annotator.project.rows import still_of
from annotator.project.stills import Sighting
from annotator.types import BoxKind, Correction, Label, ReviewState
from annotator.types.errors import ConfigError, HistoryError, ProjectError, StaleRevisionError

BASED = (*(step for step in STEPS if step not in ("bring", "import", "span")), "values", "frame values")
"""Changes that are based on a revision of a frame."""
KINDS = (*STEPS, "loose view", "link", "adjust", "estimate", "values", "frame values", "classes", "pass")
CAMERAS = {1: ["0", "1"], 2: ["0"]}
"""The keys of each recording's frames."""
SMALL = st.integers(0, 3)
PLACE = st.integers(0, 2)
OTHER = {"ann": "bob", "bob": "ann"}
PEOPLE = st.sampled_from(sorted(OTHER))


def linked(labels: Sequence[Label], track_id: int) -> TracksLinked:
    """Links all labels of a frame and moves the boxes of open proposals."""
    moved = BoxRecord.of(box_at(4.0))
    return TracksLinked(
        labels=tuple(
            LabelChanged(uid=each.uid, track_id=track_id, box=moved if each.state is ReviewState.PROPOSED else None)
            for each in labels
        )
    )


def moved_by(frames: int) -> RigidTransform:
    """Of a camera that moves on in map coordinates."""
    return RigidTransform.from_translation([500000.0 + 0.3 * frames, 4649776.0, 12.0])


def audited(project: Project) -> dict[str, list[tuple[object, ...]]]:
    """All rows of the audited tables, without what is not audited, such as the revisions.

    Classes get their ids once, which no undo takes back: their names and looks are compared where they are classes.
    """
    rows = {}
    with project.store.read() as connection:
        for table, key in AUDITED.items():
            columns = ", ".join(f'"{column}"' for column in columns_of(table))
            shown = " WHERE position IS NOT NULL" if table == "classes" else ""
            found = connection.execute(text(f'SELECT {columns} FROM {table}{shown} ORDER BY "{key}"'))
            rows[table] = list(map(tuple, found))
    return rows


class TwoOperators(RuleBasedStateMachine):
    """Edits of two operators, passes, imports, class changes, undo and redo, in any order."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        root = Path(self.folder.name)
        self.project = create_project(root, "p", ("hand", "person"))
        for number, keys in CAMERAS.items():
            T_cloud_camera = RigidTransform.from_rotation(Rotation.from_rotvec([0.0, number - 1.0, 0.0]))
            clouds = {key: SharedCloud(key, T_cloud_camera) for key in keys}
            options = json.dumps({"camera": f"c{number}"})
            poses = {key: T_cloud_camera * moved_by(n) for n, key in enumerate(keys)}
            add = self.project.recordings.add
            add(root / "r", "rgbd", f"r{number}", keys, True, options=options, clouds=clouds, poses=poses)
        self.views = [self.project.views.store(np.full((2, 2, 3), n, np.uint8)) for n in range(2)]
        self.is_removed = False
        give_attributes(self.project)
        # the row of a recording that was adjusted once stays
        for number in CAMERAS:
            self.project.adjustments.correct(number, Correction((0.0, 0.0, 0.1 * number), (0.0, 0.0, 0.0)), "bob")
        for frame in self.project.frames.of([1]):
            proposals = [proposal_at(0.0), proposal_at(5.0, "person")]
            self.project.proposals.replace(frame.id, proposals, by_machine(frame.revision))

    @rule(who=PEOPLE, steps=st.lists(st.tuples(st.sampled_from(KINDS), PLACE, SMALL, SMALL), min_size=6, max_size=16))
    def act(self, who: str, steps: list[Step]) -> None:
        """What is stale or refused changes nothing; the actions are undone one by one, and redone, exactly."""
        self._bring_back()
        project, states = self.project, [audited(self.project)]
        for step in steps:
            last = project.log.last()
            if step[0] in BASED and step[2]:
                with pytest.raises(ProjectError):  # as `step` is based on another revision
                    actions(project, self.views, step, who, behind=1)[step[0]]()
                assert audited(project) == states[-1]
            try:
                self._take(who, step)
            except (ProjectError, ConfigError):
                assert audited(project) == states[-1]
                continue
            events, after = list(project.log.since(last)), audited(project)
            if as_one(row for event in events for row in event.rows if event.action is not None):
                states.append(after)
            elif after != states[-1]:  # a pass or an import that cannot be undone
                states = [after]
        for state in reversed(states[:-1]):
            project.history.undo(who)
            assert audited(project) == state
        for state in states[1:]:
            project.history.redo(who)
            assert audited(project) == state

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
            "pass": lambda: self._pass(who, a, b),
        }
        (actions(project, self.views, step, who) | more)[what]()

    def _pass(self, who: str, a: int, b: int) -> None:
        """A batch over all frames; a finalised one is left alone."""
        project, action = self.project, new_action()
        run = project.jobs.start(image_detector="image", view_detector=f"view {b}", config_json="{}")
        for frame in project.frames.of():
            if not frame.finalised:
                context = replace(by_machine(project.frames.get(frame.id).revision), author=who, maker="rcv")
                found, share = [proposal_at(2.0 * n + 0.1 * b) for n in range(a)], RunShare(run.id, 1.0)
                project.proposals.replace(frame.id, found, context, run=share, action=action)
            assert frame not in project.jobs.pending(run.key)
        posed = next((frame for frame in project.frames.of() if not frame.finalised), None)
        if posed is not None:
            context = replace(by_machine(posed.revision), author=who, maker="rcv")
            name, track_id = project.config.classes[0], project.labels.next_track_id(1)
            new = [StillProposal(name, box_at(20.0 + n), track_id + n, 0.5, 0.2) for n in range(b % 2)]
            removed = [each.uid for each in project.stills.of(1) if each.is_open]
            project.log.append_to_frames([FramePart(posed.id, [StillsProposed(new, removed)], context)], action)

    @rule(who=PEOPLE, place=PLACE)
    def change_the_same(self, who: str, place: int) -> None:
        """An undo or redo is refused where somebody else has changed the same since, until that is undone."""
        self._bring_back()
        project, frame, name = self.project, self.project.frames.of()[place].id, self.project.config.classes[0]

        def revised(author: str) -> WriteContext:
            return by_hand(project.frames.get(frame).revision, author)

        (uid,) = project.labels.create(frame, [NewLabel(name, box_at(70.0))], revised(who)).uids
        before = audited(project)
        for author, x in ((who, 80.0), (OTHER[who], 90.0)):
            project.labels.edit(frame, uid, revised(author), label=name, box=box_at(x))
        changed = audited(project)
        with pytest.raises(HistoryError, match=f"was changed by {OTHER[who]} since"):
            project.history.undo(who)
        assert audited(project) == changed
        project.history.undo(OTHER[who])
        project.history.undo(who)
        assert audited(project) == before
        project.labels.accept(frame, uid, revised(OTHER[who]))
        with pytest.raises(HistoryError, match=f"cannot be redone because .* was changed by {OTHER[who]} since"):
            project.history.redo(who)
        project.history.undo(OTHER[who])
        assert audited(project) == before

    @rule(who=PEOPLE, places=st.permutations(range(3)), is_rejected=st.booleans())
    def stand_still(self, who: str, places: list[int], is_rejected: bool) -> None:
        """A still object is one row, which each frame shows; a frame may differ; all of it is undone step by step."""
        self._bring_back()
        project, (first, second, third) = self.project, [self.project.frames.of()[n].id for n in places]
        name, track_id = project.config.classes[0], project.labels.next_track_id(1)

        def take(frame: int, *payloads: Payload) -> None:
            states.append(audited(project))
            project.log.append(frame, payloads, by_hand(project.frames.get(frame).revision, who))

        def shown(frame: int) -> Label | None:
            return next((each for each in project.labels.of_frame(frame) if each.track_id == track_id), None)

        states: list[dict[str, list[tuple[object, ...]]]] = []
        take(first, new := NewLabel(name, box_at(30.0), track_id=track_id))
        states.append(audited(project))
        made, seen = StillMade(uid=new.uid), project.frames.of()
        context = by_hand(project.frames.get(first).revision, who)
        sightings = [Sighting(made.still, each.id, each.moment_id, True) for each in seen]
        project.stills.change([FramePart(first, [made], context)], sightings)
        at_third = shown(third)
        late, seen_there = project.frames.get(third).revision, shown(second)
        assert seen_there is not None and at_third is not None
        moved = LabelChanged(uid=seen_there.uid, state=ReviewState.EDITED, box=BoxRecord.of(box_at(40.0)))
        take(second, moved)
        assert [key for key in AUDITED if audited(project)[key] != states[-1][key]] == ["stills"]
        now = shown(third)
        assert now is not None and not same_box(now.box, at_third.box)
        with pytest.raises(StaleRevisionError):
            project.log.append(third, [LabelChanged(uid=now.uid, label=name)], by_hand(late, who))
        given = {"state": ReviewState.REJECTED} if is_rejected else {"box": BoxRecord.of(box_at(50.0))}
        take(third, LabelChanged(uid=now.uid, here=True, **given))
        own = shown(third)
        assert own is not None and still_of(own.uid) is None and project.stills.of(1)
        for state in reversed(states):
            project.history.undo(who)
            assert audited(project) == state

    @rule(who=PEOPLE, is_undo=st.booleans(), skip=st.booleans())
    def step(self, who: str, is_undo: bool, skip: bool) -> None:
        """A refused step changes nothing."""
        before = audited(self.project)
        try:
            (self.project.history.undo if is_undo else self.project.history.redo)(who, skip=skip)
        except HistoryError:
            assert audited(self.project) == before

    @rule()
    def remove(self) -> None:
        """A removed recording has nothing to show, and comes back as it was."""
        self._bring_back()
        before = sorted_state(self.project)
        for _ in range(2):
            self._bring_back()
            assert sorted_state(self.project) == before
            for number in CAMERAS:
                self.project.recordings.remove(number, "ann")
            self.is_removed = True
            assert (self.project.labels.select(), self.project.boxes.on_images(), self.project.frames.of()) == ((),) * 3

    def _bring_back(self) -> None:
        if self.is_removed:
            for number, keys in CAMERAS.items():
                self.project.recordings.rescan(number, keys)
        self.is_removed = False

    @rule()
    def replay(self) -> None:
        """The tables are those that the audit gives, and stay so; so are the next steps of both operators."""
        steps = [self.project.history.next(who) for who in OTHER]
        self.project.close()
        self.project = open_project(self.project.path)
        assert [self.project.history.next(who) for who in OTHER] == steps
        before, events = state_of(self.project), list(self.project.log.since())
        assert self.project.log.rebuild() == len(events)
        assert state_of(self.project) == before
        assert list(self.project.log.since()) == events

    def teardown(self) -> None:
        try:
            self.replay()
            assert self.project.problems() == []
        finally:
            self.project.close()
            self.folder.cleanup()


TestTwoOperators = TwoOperators.TestCase
TestTwoOperators.settings = settings(
    max_examples=20,
    stateful_step_count=6,
    suppress_health_check=[HealthCheck.too_slow],
    # an example takes a second: to shrink one that fails would take minutes
    phases=(Phase.explicit, Phase.generate),
)
