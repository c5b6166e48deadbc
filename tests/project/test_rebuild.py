"""The state that is kept up with every event is the state that all events together make."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from sqlalchemy import text
from store_samples import box_at, by_hand, by_machine, lost_object, proposal_at, state_of

from annotator.project import NewLabel, Project, create_project
from annotator.project.payloads import LabelAccepted, LabelDeleted
from annotator.types import Box2D, BoxKind
from annotator.types.errors import FinalisedFrameError, ProjectError

# one step: what to do, on which of three frames, and two small numbers that say how
STEPS = st.lists(
    st.tuples(
        st.sampled_from(
            ["propose", "create", "accept", "edit", "reject", "delete", "image", "view", "loose view", "lock", "bulk"]
        ),
        st.integers(0, 2),
        st.integers(0, 3),
        st.integers(0, 3),
    ),
    min_size=1,
    max_size=16,
)


def _boxes(count: int) -> list[Box2D]:
    return [Box2D("hand", float(n), 0.0, n + 1.5, 2.0) for n in range(count)]


def _take(project: Project, views: list[str], step: tuple[str, int, int, int]) -> None:
    """Do one step; what the present state does not allow is refused, which is part of the game."""
    what, place, a, b = step
    frame = project.frames.of()[place]
    labels = project.labels.of_frame(frame.id)
    change = by_hand(frame.revision)
    uid = labels[a % len(labels)].uid if labels else "nobody"
    actions: dict[str, Callable[[], object]] = {
        "propose": lambda: project.proposals.replace(
            frame.id,
            [proposal_at(2.0 * n + 0.1 * b, ("hand", "person")[n % 2]) for n in range(a)],
            by_machine(frame.revision),
            lost=[lost_object()] * b,
        ),
        "create": lambda: project.labels.create(
            frame.id, [NewLabel("hand", box_at(2.0 * n)) for n in range(a)], change
        ),
        "accept": lambda: project.labels.accept(frame.id, uid, change),
        "edit": lambda: project.labels.edit(frame.id, uid, change, label="person", box=box_at(b), track_id=b or None),
        "reject": lambda: project.labels.reject(frame.id, uid, change),
        "delete": lambda: project.labels.delete(frame.id, uid, change),
        "image": lambda: project.boxes.set_on_image(frame.id, _boxes(a), list(BoxKind)[b % 2], change),
        "view": lambda: project.boxes.set_on_view(views[b % 2], _boxes(a), BoxKind.BOX, change, frame_id=frame.id),
        "loose view": lambda: project.boxes.set_on_view(
            views[b % 2],
            _boxes(a),
            BoxKind.BOX,
            by_hand(
                max(
                    (
                        view.revision
                        for view in project.boxes.on_views()
                        if view.frame_id is None and view.view_id == views[b % 2]
                    ),
                    default=0,
                )
            ),
        ),
        "lock": lambda: (project.frames.reopen if frame.finalised else project.frames.finalise)(frame.id, change),
        "bulk": lambda: project.log.append(
            frame.id, [LabelAccepted(uid=label.uid) for label in labels] + [LabelDeleted(uid=uid)], change
        ),
    }
    try:
        actions[what]()
    except FinalisedFrameError:
        assert frame.finalised
    except ProjectError:
        assert not labels, "only a change of a label that is not there may be refused"


@settings(max_examples=30, deadline=None)
@given(STEPS)
def test_rebuilt_and_maintained_state_agree(steps: list[tuple[str, int, int, int]]) -> None:
    with tempfile.TemporaryDirectory() as folder, create_project(Path(folder), "p", ("hand", "person")) as project:
        project.recordings.add(Path(folder) / "r", "rgbd", "r", ["0", "1", "2"], True)
        views = [project.views.store(np.full((2, 2, 3), n, np.uint8)) for n in range(2)]
        for step in steps:
            _take(project, views, step)
        before = state_of(project)
        order = [[label.uid for label in project.labels.of_frame(n)] for n in (1, 2, 3)]
        events = [event.payload.model_dump_json() for event in project.log.since()]
        assert project.log.rebuild() == len(events)
        assert state_of(project) == before
        assert [[label.uid for label in project.labels.of_frame(n)] for n in (1, 2, 3)] == order
        assert [event.payload.model_dump_json() for event in project.log.since()] == events
        assert project.problems() == []


def test_rebuilding_repairs_a_spoilt_state(project: Project, frame: int) -> None:
    uids = project.proposals.replace(frame, [proposal_at(0.0), proposal_at(5.0)], by_machine()).uids
    project.labels.accept(frame, uids[0], by_hand(1))
    before = state_of(project)
    with project.store.write() as connection:
        connection.execute(text("UPDATE labels SET state = 'rejected', frame_id = 1"))
        connection.execute(text("UPDATE frames SET revision = 9, finalised = 1"))
    assert state_of(project) != before
    assert project.log.rebuild() == 2
    assert state_of(project) == before


def test_a_long_log_is_replayed_in_pieces(project: Project, frame: int) -> None:
    for revision in range(120):
        project.boxes.set_on_image(frame, _boxes(revision % 3), BoxKind.BOX, by_hand(revision))
    assert [event.revision for event in project.log.since()] == list(range(1, 121))
    before = state_of(project)
    assert project.log.rebuild() == 120
    assert state_of(project) == before
