"""Who gets which task, and what becomes of the tasks of workers that die: with workers that are no processes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from annotator.project import BoxRotation
from annotator.rcv.config import RcvConfig
from annotator.rcv.finish import FrameProposals
from annotator.types import BoxKind
from annotator.types.errors import WorkerError
from annotator.workflows.proposing.engines import pool
from annotator.workflows.proposing.engines.messages import Died, Done, Ready, Refused, Report
from annotator.workflows.proposing.engines.pool import MAX_FAILED_STARTS, TASKS_PER_WORKER, WorkerPool
from annotator.workflows.proposing.engines.tasks import Answer, FrameAnswer, FrameSpec, Identity, RecordingSpec, Task

SAME = Identity("image", "view", ("torch", "torch"), BoxKind.BOX)
ROOM = RecordingSpec(Path("room"), "room", "project", None)


@dataclass(eq=False)
class Paper:
    """A worker that does what the test says, and dies of frames whose keys it is told."""

    number: int
    tell: Report
    tasks: list[Task] = field(default_factory=list)
    is_ended: bool = False

    def send(self, task: Task) -> None:
        self.tasks.append(task)

    def end(self) -> None:
        self.is_ended = True

    def ready(self) -> Paper:
        self.tell(Ready(self.number, SAME))
        return self

    def do(self) -> None:
        task = self.tasks.pop(0)
        answers = tuple(FrameAnswer(FrameProposals(frame.key, (), ()), None, 1.0) for frame in task.frames)
        self.tell(Done(self.number, Answer(task.number, answers)))

    def die(self) -> None:
        self.tasks.clear()
        self.tell(Died(self.number, "killed"))


@dataclass(eq=False)
class Office:
    """A pool and all workers that it has ever made."""

    workers: int
    made: list[Paper] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.pool = WorkerPool(self._make, self.workers)

    def _make(self, number: int, tell: Report) -> Paper:
        self.made.append(Paper(number, tell))
        return self.made[-1]

    def start(self) -> None:
        while len(self.made) < self.workers:
            self.pool._add()
        for paper in self.made:
            paper.ready()
        self.pool.start()
        self.drain()

    def drain(self) -> list[Answer]:
        answers = []
        while (answer := self.pool.wait(0.01)) is not None or not self.pool._events.empty():
            answers += [answer] if answer is not None else []
        return answers


def task(number: int, *keys: str) -> Task:
    return Task(number, tuple(FrameSpec(ROOM, key) for key in keys), RcvConfig(), BoxRotation.FREE)


def keys(paper: Paper) -> list[tuple[str, ...]]:
    return [tuple(frame.key for frame in held.frames) for held in paper.tasks]


@pytest.fixture
def office() -> Callable[[int], Office]:
    def open_office(workers: int) -> Office:
        made = Office(workers)
        made.start()
        return made

    return open_office


def test_a_worker_holds_one_task_to_do_and_one_to_read(office: Callable[[int], Office]) -> None:
    desk = office(2)
    for number in range(6):
        desk.pool.submit(task(number, str(number)))
    assert [len(paper.tasks) for paper in desk.made] == [TASKS_PER_WORKER, TASKS_PER_WORKER]
    desk.made[1].do()
    assert [answer.number for answer in desk.drain()] == [2]
    assert keys(desk.made[1])[-1] == ("4",)


def test_tasks_of_a_worker_that_died_go_alone_to_others_and_nothing_is_lost(office: Callable[[int], Office]) -> None:
    desk = office(1)
    for number in range(4):
        desk.pool.submit(task(number, f"{number}a", f"{number}b"))
    desk.made[0].die()
    desk.drain()
    second = desk.made[1].ready()
    desk.drain()
    answers = []
    for _ in range(2):  # suspects: nothing beside them
        assert len(keys(second)) == 1
        second.do()
        answers += desk.drain()
    assert len(second.tasks) == TASKS_PER_WORKER
    for _ in range(2):
        second.do()
    answers += desk.drain()
    assert sorted(answer.number for answer in answers) == [0, 1, 2, 3]
    assert all(frame.result is not None for answer in answers for frame in answer.frames)


def test_a_frame_that_kills_again_and_again_has_failed_and_the_others_of_its_task_are_done(
    office: Callable[[int], Office],
) -> None:
    desk = office(1)
    desk.pool.submit(task(7, "good", "deadly", "fine"))
    answers: list[Answer] = []
    for _ in range(20):
        paper = desk.made[-1]
        if not paper.tasks:
            paper.ready()
            desk.drain()
        if any("deadly" in held for held in keys(paper)):
            paper.die()
        else:
            paper.do()
        answers = desk.drain()
        if answers:
            break
    (answer,) = answers
    assert answer.number == 7
    assert [frame.result.key if frame.result else None for frame in answer.frames] == ["good", None, "fine"]
    reason = answer.frames[1].reason
    assert reason is not None and "a worker has ended 2 times on this frame, the last time killed" in reason
    assert len(desk.made) == 4, "in company twice, alone once"


def test_workers_that_die_before_they_are_ready_end_the_batch() -> None:
    desk = Office(1)
    for _ in range(MAX_FAILED_STARTS):
        desk.pool._add()
        desk.made[-1].die()
    with pytest.raises(WorkerError, match="before they were ready, the last one killed"):
        desk.pool.start()


def test_workers_with_other_detectors_are_refused(office: Callable[[int], Office]) -> None:
    desk = office(2)
    desk.made[0].tell(Ready(1, Identity("image", "view", ("openvino", "torch"), BoxKind.BOX)))
    with pytest.raises(WorkerError, match="detectors differ"):
        desk.drain()


def test_a_fault_is_no_error_for_users() -> None:
    desk = Office(1)
    desk.pool._add()
    desk.made[0].tell(Refused(1, "Traceback ...", True))
    with pytest.raises(RuntimeError, match="Traceback"):
        desk.pool.start()


def test_closing_ends_all_workers(office: Callable[[int], Office]) -> None:
    desk = office(3)
    desk.pool.close()
    desk.pool.close()
    assert all(paper.is_ended for paper in desk.made)


def test_a_wait_for_the_first_worker_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a cluster whose cores are all in use."""
    monkeypatch.setattr(pool, "WARNING_INTERVAL_S", 0.01)
    office = Office(2)
    told: list[str] = []

    def warning(line: str, *values: object) -> None:
        told.append(line % values)
        if len(told) == 2:
            office.made[0].ready()

    monkeypatch.setattr(pool.LOG, "warning", warning)
    assert office.pool.start() == SAME
    assert len(told) == 2
    assert "none of the 2 workers is ready after 0 s" in told[0]
