"""Stale writes and automatic writes to finalised frames are refused; a refused write changes nothing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from sqlalchemy import Engine, event
from store_samples import box_at, by_hand, by_machine, proposal_at, state_of

from annotator.project import NewLabel, Project, WriteContext, create_project
from annotator.types import Box2D, BoxKind, Source
from annotator.types.errors import FinalisedFrameError, ProjectError, StaleRevisionError

HAND = Box2D("hand", 1.0, 2.0, 3.0, 4.0)


@pytest.mark.parametrize("change", [by_hand, by_machine])
def test_a_stale_write_is_refused_with_both_revisions(project: Project, frame: int, change) -> None:
    for other in project.frames.of():
        project.boxes.set_on_image(other.id, [HAND], BoxKind.BOX, by_hand())
    with pytest.raises(StaleRevisionError, match="frame 2 of recording take is at revision 1") as caught:
        project.proposals.replace(frame, [proposal_at()], change(2))
    assert (caught.value.expected, caught.value.actual) == (2, 1)
    project.proposals.replace(frame, [proposal_at()], change(1))


def test_a_snapshot_does_not_see_what_is_written_meanwhile(project: Project, frame: int) -> None:
    with project.store.snapshot():
        assert project.frames.get(frame).revision == 0
        project.labels.create(frame, [NewLabel("hand", box_at(0))], by_hand())
        assert (project.frames.get(frame).revision, project.labels.of_frame(frame)) == (0, ())
        # a change that is based on it is refused, as any other
        with pytest.raises(StaleRevisionError):
            project.labels.create(frame, [NewLabel("hand", box_at(1))], by_hand())
    assert project.frames.get(frame).revision == len(project.labels.of_frame(frame)) == 1


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


def test_an_operator_may_change_and_reopen_a_finalised_frame_once(project: Project, frame: int) -> None:
    with pytest.raises(ProjectError, match="frame 2 of recording take: the frame is not finalised"):
        project.frames.reopen(frame, by_hand())
    project.frames.finalise(frame, by_hand())
    project.boxes.set_on_image(frame, [HAND], BoxKind.BOX, by_hand(1))
    with pytest.raises(ProjectError, match="already finalised"):
        project.frames.finalise(frame, by_hand(2))
    project.frames.reopen(frame, by_hand(2))
    project.proposals.replace(frame, [proposal_at()], by_machine(3))
    assert len(project.labels.of_frame(frame)) == 1


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


def test_every_event_has_author_time_and_source(project: Project, frame: int) -> None:
    project.boxes.set_on_image(frame, [HAND], BoxKind.BOX, WriteContext(0, "importer", Source.IMPORTED))
    (event,) = project.log.of_frame(frame)
    assert (event.author, event.source) == ("importer", Source.IMPORTED)
    assert event.time_ns > 1_700_000_000 * 10**9
    with pytest.raises(ProjectError, match="needs an author"):
        WriteContext(1, "  ")


@contextmanager
def counted() -> Iterator[list[str]]:
    """Collects the SQL statements within the block."""
    executed: list[str] = []

    def record(connection, cursor, statement, parameters, context, many) -> None:
        executed.append(statement)

    event.listen(Engine, "before_cursor_execute", record)
    try:
        yield executed
    finally:
        event.remove(Engine, "before_cursor_execute", record)


def test_a_longer_recording_needs_no_more_statements(tmp_path: Path) -> None:
    counts = []
    for frames in (20, 2_000):
        with create_project(tmp_path, f"long{frames}", ("hand",)) as project, counted() as executed:
            project.recordings.add(tmp_path / "r", "rgbd", "long", [f"{n:06d}" for n in range(frames)], True)
            run = project.jobs.start(image_detector="a", view_detector="b", config_json="{}")
            assert len(project.jobs.pending(run.key)) == frames
            _ = project.statistics(), project.frames.of(), project.labels.select()
            counts.append(len(executed))
    assert counts[0] == counts[1] < 100
