"""With kills at any moment and concurrent processes, no acknowledged write is lost and no write is partial."""

from __future__ import annotations

import random
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from store_samples import by_hand, proposal_at, state_of

from annotator.project import Project, StoredRecording, open_project
from annotator.types import BoxKind
from annotator.types.errors import ProjectError

HERE = Path(__file__).parent


@contextmanager
def _writer(project: Path) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-c", _RUN, str(HERE), str(HERE.parent.parent), str(project)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        with process:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            try:
                yield process
            finally:
                process.kill()
    finally:
        process.wait()


# the helper's folder and the repository are on the path whatever the current directory is
_RUN = "import sys; sys.path[:0] = sys.argv[1:3]; del sys.argv[1:3]; import writer_process; writer_process.main()"


def _send(process: subprocess.Popen[str], line: str) -> None:
    assert process.stdin is not None
    process.stdin.write(line + "\n")
    process.stdin.flush()


def _answer(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def _complete_lines(process: subprocess.Popen[str]) -> list[tuple[int, int]]:
    assert process.stdout is not None
    # the kill may truncate the last line
    lines = [line for line in process.stdout.read().splitlines(keepends=True) if line.endswith("\n")]
    return list(map(_written, lines))


def _written(line: str) -> tuple[int, int]:
    number, revision = map(int, line.split()[:2])
    return number, revision


def test_acknowledged_writes_survive_a_kill_at_any_moment(project: Project, recording: StoredRecording) -> None:
    moments = random.Random(5)
    frames = [frame.id for frame in project.frames.of()]
    project.close()
    for round_ in range(2):
        frame = frames[round_ % len(frames)]
        with _writer(project.path) as process:
            _send(process, f"loop {frame}")
            # the kill comes after some work
            first = [_written(_answer(process)) for _ in range(5)]
            time.sleep(moments.uniform(0.0, 0.2))
            process.kill()
            written = first + _complete_lines(process)
        with open_project(project.path) as reopened:
            assert reopened.problems() == []
            events = {event.id: event.revision for event in reopened.log.since()}
            assert all(events.get(number) == revision for number, revision in written)
            log = reopened.log.of_frame(frame)
            # at most one write was committed but not yet acknowledged
            assert len(log) - max((revision for _, revision in written), default=len(log)) in (0, 1)
            assert reopened.frames.get(frame).revision == len(log)
            maintained = state_of(reopened)
            assert reopened.log.rebuild() == len(events)
            assert state_of(reopened) == maintained


def test_two_processes_write_to_different_frames_and_one_of_them_on_a_revision(
    project: Project, recording: StoredRecording
) -> None:
    frames = [frame.id for frame in project.frames.of()][:2]
    rounds, wins = 10, [0, 0]
    with _writer(project.path) as one, _writer(project.path) as two:
        for revision in range(rounds):
            for process, frame in ((one, frames[0]), (two, frames[1])):
                _send(process, f"once {frame} {revision}")
        for process in (one, two):
            assert [_answer(process) for _ in range(rounds)] == ["won"] * rounds
        for revision in range(rounds, 2 * rounds):
            for process in (one, two) if revision % 2 else (two, one):
                _send(process, f"once {frames[0]} {revision}")
            answers = [_answer(process) for process in (one, two)]
            assert sorted(answers) == ["stale", "won"]
            wins[answers.index("won")] += 1
    assert sum(wins) == rounds
    assert [event.revision for event in project.log.of_frame(frames[0])] == list(range(1, 2 * rounds + 1))
    assert project.frames.get(frames[1]).revision == rounds


def test_an_error_inside_a_write_rolls_it_back(project: Project, frame: int) -> None:
    with pytest.raises(ZeroDivisionError), project.store.write() as connection:
        connection.exec_driver_sql("UPDATE frames SET revision = 7")
        _ = 1 // 0
    assert project.frames.get(frame).revision == 0


def test_a_full_disk_is_reported_and_loses_nothing(project: Project, frame: int) -> None:
    project.boxes.set_on_image(frame, [], BoxKind.BOX, by_hand())
    before = state_of(project)
    with project.store.read() as connection:  # the pool's only connection so far, so the write uses it too
        pages = connection.exec_driver_sql("PRAGMA page_count").scalar_one()
        connection.exec_driver_sql(f"PRAGMA max_page_count = {pages + 2}")
    many = [proposal_at(5.0 * n, steps=2, views=8) for n in range(100)]
    with pytest.raises(
        ProjectError, match=r"project\.db: cannot be written, because the disk is full; nothing was changed"
    ):
        project.proposals.replace(frame, many, by_hand(1))
    assert state_of(project) == before
    assert project.problems() == []
    with open_project(project.path) as reopened:
        reopened.proposals.replace(frame, many, by_hand(1))
