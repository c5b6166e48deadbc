"""The number of SQL statements does not depend on the number of frames.

(`python -m benchmarks.store` measures the times.)
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from sqlalchemy import Engine, event
from store_samples import by_machine, proposal_at

from annotator.project import Project, RunShare, create_project

Counted = Callable[[Callable[[], object]], int]


@pytest.fixture
def statements() -> Counted:
    """`statements(work)` -> the number of SQL statements during `work`."""

    def count(work: Callable[[], object]) -> int:
        executed: list[str] = []

        def record(connection, cursor, statement, parameters, context, many) -> None:
            executed.append(statement)

        event.listen(Engine, "before_cursor_execute", record)
        try:
            work()
        finally:
            event.remove(Engine, "before_cursor_execute", record)
        return len(executed)

    return count


@pytest.fixture
def of_length(tmp_path: Path) -> Callable[[int], Project]:
    """Creates a project with a recording of the given number of frames."""

    def make(frames: int) -> Project:
        project = create_project(tmp_path, f"long{frames}", ("hand",))
        project.recordings.add(tmp_path / "recording", "rgbd", "long", [f"{n:06d}" for n in range(frames)], True)
        return project

    return make


def test_a_longer_recording_needs_no_more_statements(statements: Counted, of_length: Callable[[int], Project]) -> None:
    counts = {}
    for frames in (20, 2_000):
        with of_length(frames) as project:
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
            counts[frames] = [statements(work) for work in asked]
    assert counts[20] == counts[2_000]
    assert max(counts[20]) < 40, counts


def test_adding_a_recording_needs_few_statements(project: Project, tmp_path: Path, statements: Counted) -> None:
    keys = [f"{n:06d}" for n in range(2_000)]
    assert statements(lambda: project.recordings.add(tmp_path / "long", "rgbd", "long", keys, True)) < 30


def test_storing_the_proposals_of_a_frame_needs_few_statements(
    project: Project, tmp_path: Path, statements: Counted
) -> None:
    project.recordings.add(tmp_path / "long", "rgbd", "long", [str(n) for n in range(100)], True)
    frames = project.frames.of()
    proposals = [proposal_at(5.0 * n, steps=3, views=8) for n in range(3)]
    counts = [
        statements(lambda: project.proposals.replace(frame.id, proposals, by_machine()))  # noqa: B023
        for frame in frames[:20]
    ]
    assert max(counts) < 60, "statements per frame"
    assert len(set(counts[5:])) == 1, "the number is constant once other frames have proposals"
