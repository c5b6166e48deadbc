"""Stale writes and automatic writes to finalised frames are refused; a refused write changes nothing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from sqlalchemy import Engine, event
from store_samples import box_at, by_hand, by_machine, proposal_at, state_of

from annotator.project import NewLabel, Project, RunShare, WriteContext, create_project
from annotator.project.changes import FrameFinalised, LabelAccepted, LabelRejected
from annotator.types import Box2D, BoxKind, ReviewState, Source
from annotator.types.errors import FinalisedFrameError, ProjectError, StaleRevisionError

HAND = Box2D("hand", 1.0, 2.0, 3.0, 4.0)


def test_every_event_raises_the_revision_by_one(project: Project, frame: int) -> None:
    receipt = project.labels.create(frame, [NewLabel("hand", box_at(n)) for n in range(3)], by_hand()).receipt
    assert receipt.revision == 3
    assert project.frames.get(frame).revision == 3
    assert [event.revision for event in project.log.of_frame(frame)] == [1, 2, 3]
    assert receipt.event_ids == tuple(event.id for event in project.log.of_frame(frame))


@pytest.mark.parametrize("revision", [0, 2, -1])
@pytest.mark.parametrize("change", [by_hand, by_machine])
def test_a_stale_write_is_refused_and_changes_nothing(project: Project, frame: int, revision: int, change) -> None:
    project.boxes.set_on_image(frame, [HAND], BoxKind.BOX, by_hand())
    before = state_of(project)
    with pytest.raises(StaleRevisionError, match="frame 2 of recording take is at revision 1") as caught:
        project.boxes.set_on_image(frame, [], BoxKind.BOX, change(revision))
    assert (caught.value.expected, caught.value.actual) == (revision, 1)
    with pytest.raises(StaleRevisionError):
        project.proposals.replace(frame, [proposal_at()], change(revision))
    assert state_of(project) == before
    assert len(project.log.of_frame(frame)) == 1


def test_a_snapshot_does_not_see_what_is_written_meanwhile(project: Project, frame: int) -> None:
    with project.store.snapshot():
        assert project.frames.get(frame).revision == 0
        project.labels.create(frame, [NewLabel("hand", box_at(0))], by_hand())
        assert (project.frames.get(frame).revision, project.labels.of_frame(frame)) == (0, ())
        # a change that is based on it is refused, as any other
        with pytest.raises(StaleRevisionError):
            project.labels.create(frame, [NewLabel("hand", box_at(1))], by_hand())
    assert project.frames.get(frame).revision == len(project.labels.of_frame(frame)) == 1


def test_other_frames_do_not_make_a_write_stale(project: Project, frame: int) -> None:
    for other in project.frames.of():
        project.boxes.set_on_image(other.id, [HAND], BoxKind.BOX, by_hand())
    project.boxes.set_on_image(frame, [], BoxKind.BOX, by_hand(1))


def test_a_finalised_frame_refuses_automatic_writes(project: Project, frame: int) -> None:
    project.frames.finalise(frame, by_hand())
    before = state_of(project)
    for revision in (0, 1):
        for refused in (
            lambda change: project.proposals.replace(frame, [proposal_at()], change),
            lambda change: project.boxes.set_on_image(frame, [HAND], BoxKind.BOX, change),
            lambda change: project.frames.reopen(frame, change),
        ):
            with pytest.raises(FinalisedFrameError, match="frame 2 of recording take is finalised"):
                refused(by_machine(revision))
    assert state_of(project) == before


def test_an_operator_may_change_and_reopen_a_finalised_frame(project: Project, frame: int) -> None:
    project.frames.finalise(frame, by_hand())
    project.boxes.set_on_image(frame, [HAND], BoxKind.BOX, by_hand(1))
    project.frames.reopen(frame, by_hand(2))
    assert not project.frames.get(frame).finalised
    project.proposals.replace(frame, [proposal_at()], by_machine(3))
    assert len(project.labels.of_frame(frame)) == 1


def test_finalising_or_reopening_twice_is_refused(project: Project, frame: int) -> None:
    with pytest.raises(ProjectError, match="frame 2 of recording take: the frame is not finalised"):
        project.frames.reopen(frame, by_hand())
    project.frames.finalise(frame, by_hand())
    with pytest.raises(ProjectError, match="already finalised"):
        project.frames.finalise(frame, by_hand(1))
    assert project.frames.get(frame).revision == 1


def test_several_events_are_stored_together_or_not_at_all(project: Project, frame: int) -> None:
    uids = project.proposals.replace(frame, [proposal_at(0.0), proposal_at(5.0)], by_machine()).uids
    before = state_of(project)
    some = [LabelAccepted(uid=uids[0]), FrameFinalised(), LabelRejected(uid="nobody")]
    with pytest.raises(ProjectError, match="label nobody is not in this frame"):
        project.log.append(frame, some, by_hand(1))
    assert state_of(project) == before
    project.log.append(frame, [LabelAccepted(uid=uids[0]), LabelRejected(uid=uids[1]), FrameFinalised()], by_hand(1))
    states = [label.state for label in project.labels.of_frame(frame)]
    assert states == [ReviewState.ACCEPTED, ReviewState.REJECTED]
    assert project.frames.get(frame).finalised


def test_an_unknown_class_is_refused(project: Project, frame: int) -> None:
    stray = Box2D("hnad", 0.0, 0.0, 1.0, 1.0)
    for refused in (
        lambda: project.boxes.set_on_image(frame, [HAND, stray], BoxKind.BOX, by_hand()),
        lambda: project.labels.create(frame, [NewLabel("hnad", box_at())], by_hand()),
        lambda: project.proposals.replace(frame, [proposal_at(label="hnad")], by_machine()),
    ):
        with pytest.raises(ProjectError, match=r"'hnad' is not a class of the project; did you mean 'hand'\?"):
            refused()
    assert project.frames.get(frame).revision == 0


def test_every_event_has_author_time_and_source(tmp_path, project: Project, frame: int) -> None:
    project.boxes.set_on_image(frame, [HAND], BoxKind.BOX, WriteContext(0, "importer", Source.IMPORTED))
    (event,) = project.log.of_frame(frame)
    assert (event.author, event.source) == ("importer", Source.IMPORTED)
    assert event.time_ns > 1_700_000_000 * 10**9
    with pytest.raises(ProjectError, match="needs an author"):
        WriteContext(1, "  ")


# --- the number of SQL statements does not depend on the number of frames ---------------------------------------------


def statements(work: Callable[[], object]) -> int:
    """The number of SQL statements during `work`."""
    executed: list[str] = []

    def record(connection, cursor, statement, parameters, context, many) -> None:
        executed.append(statement)

    event.listen(Engine, "before_cursor_execute", record)
    try:
        work()
    finally:
        event.remove(Engine, "before_cursor_execute", record)
    return len(executed)


def test_a_longer_recording_needs_no_more_statements(tmp_path: Path) -> None:
    counts = {}
    for frames in (20, 2_000):
        with create_project(tmp_path, f"long{frames}", ("hand",)) as project:
            keys = [f"{n:06d}" for n in range(frames)]
            counts[frames] = [
                statements(
                    lambda: project.recordings.add(tmp_path / "long", "rgbd", "long", keys, True)  # noqa: B023
                )
            ]
            run = project.jobs.start(image_detector="a", view_detector="b", config_json="{}")
            for frame in project.frames.of()[:10]:
                project.proposals.replace(frame.id, [proposal_at()], by_machine(), run=RunShare(run.id, 0.1))
            assert len(project.jobs.pending(run.key)) == frames - 10
            asked: list[Callable[[], object]] = [
                lambda: project.jobs.pending(run.key),  # noqa: B023
                project.statistics,
                project.frames.of,
                project.labels.select,
            ]
            counts[frames] += [statements(work) for work in asked]
    assert counts[20] == counts[2_000]
    assert max(counts[20]) < 40, counts
