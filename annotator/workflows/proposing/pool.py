"""A pool of workers: distributes tasks, replaces dead workers, and finds the frames that kill them.

A worker holds two tasks: it processes one and reads the frames of the other. When a worker dies, both tasks become
suspects. A suspect is given to an idle worker, which gets no other task in the meantime: if that worker dies, the
suspect is the cause. A task that kills a second worker is split into its frames, and a frame that kills another worker
has failed.

Libraries' pools were tried: `pebble.ProcessPool` 5.2 sends the answers of all workers through one locked pipe, so a
worker that is killed while it sends leaves the others waiting forever; and Ray's actors need this pool, too.
"""

from __future__ import annotations

import logging
import queue
import time
import traceback
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

from annotator.types.errors import AnnotatorError, WorkerError
from annotator.workflows.proposing.tasks import Answer, FrameAnswer, Identity, Task


@dataclass(frozen=True)
class Fault:
    """Why a worker cannot start; a replacement would fail, too.

    Attributes:
        reason: a message, or a traceback if `is_fault`.
        is_fault: True for an error in the program, False for an error of the user.
    """

    reason: str
    is_fault: bool


def fault_of(error: Exception) -> Fault:
    if isinstance(error, AnnotatorError):
        return Fault(str(error), False)
    return Fault("".join(traceback.format_exception(error)), True)


@dataclass(frozen=True)
class Died:
    """The worker has ended unexpectedly."""

    reason: str


Message = Identity | Answer | Fault | Died
"""What a worker tells: the identity of its detectors once it has loaded them, answers, and why it has ended, last."""
Report = Callable[[int, Message], None]
"""Receives a worker's number and message, from any thread."""


@runtime_checkable
class Worker(Protocol):
    """A worker process, which tells the `Report` that it was made with."""

    def send(self, task: Task) -> None:
        """Sends a task; does nothing if the worker is dead."""
        ...

    def end(self) -> None:
        """Ends the worker at once."""
        ...


LOG = logging.getLogger("annotator.engines")

# Tasks that a worker holds: one in process, one being read.
TASKS_PER_WORKER = 2
# A task that has killed this many workers is split into its frames; a single frame has failed.
MAX_DEATHS = 2
# The pool gives up after this many workers in a row have died before they were ready.
MAX_FAILED_STARTS = 3
# Interval of warnings while no worker is ready. Loading takes some seconds.
WARNING_INTERVAL_S = 30.0


MakeWorker = Callable[[int, Report], Worker]
"""Makes the worker with a number."""


@dataclass(eq=False)
class _Job:
    """A task, or one frame of a split task.

    Attributes:
        deaths: number of workers that it may have killed.
        split: the task that it is a frame of, or None.
        index: of its frame in that task.
    """

    task: Task
    deaths: int = 0
    split: _Split | None = None
    index: int = 0


@dataclass(eq=False)
class _Split:
    """A task whose frames are sent one by one, and their answers by index."""

    task: Task
    answers: dict[int, FrameAnswer] = field(default_factory=dict)


@dataclass(eq=False)
class _Slot:
    """A worker and its jobs by number."""

    worker: Worker
    is_ready: bool = False
    jobs: dict[int, _Job] = field(default_factory=dict)

    @property
    def has_suspect(self) -> bool:
        return any(job.deaths for job in self.jobs.values())


class WorkerPool:
    """An engine with a fixed number of workers."""

    def __init__(self, make: MakeWorker, workers: int) -> None:
        self._make, self._workers = make, workers
        self._events: queue.SimpleQueue[tuple[int, Message]] = queue.SimpleQueue()
        self._slots: dict[int, _Slot] = {}
        self._waiting: deque[_Job] = deque()
        self._suspects: deque[_Job] = deque()
        self._answers: deque[Answer] = deque()
        self._identity: Identity | None = None
        self._jobs_sent = 0
        self._workers_made = self._failed_starts = 0

    @property
    def window(self) -> int:
        # one more per worker, so that all stay busy while the oldest task is still running
        return self._workers * (TASKS_PER_WORKER + 1)

    def start(self) -> Identity:
        """Starts the workers, and returns when the first is ready. Logs a warning if that takes long."""
        while len(self._slots) < self._workers:
            self._add()
        begin = time.monotonic()
        while self._identity is None:
            try:
                self._handle(*self._events.get(timeout=WARNING_INTERVAL_S))
            except queue.Empty:
                LOG.warning(
                    "none of the %d workers is ready after %.0f s; a cluster starts them once it has free cores",
                    self._workers,
                    time.monotonic() - begin,
                )
        return self._identity

    def start_all(self) -> Identity:
        """As `start`, but returns when all workers are ready."""
        identity = self.start()
        while not all(slot.is_ready for slot in self._slots.values()):
            self._handle(*self._events.get())
        return identity

    def submit(self, task: Task) -> None:
        """Adds a task."""
        self._waiting.append(_Job(task))
        self._distribute()

    def wait(self, timeout_s: float) -> Answer | None:
        """Waits for the next answer; returns None after `timeout_s` seconds."""
        if not self._answers:
            try:
                self._handle(*self._events.get(timeout=timeout_s))
            except queue.Empty:
                return None
        return self._answers.popleft() if self._answers else None

    def close(self) -> None:
        """Ends all workers at once."""
        slots, self._slots = self._slots, {}
        for slot in slots.values():
            slot.worker.end()

    # --- events ------------------------------------------------------------------------------------------------------

    def _handle(self, number: int, message: Message) -> None:
        slot = self._slots.get(number)
        if slot is None:  # a worker that was dropped
            return
        match message:
            case Identity():
                self._set_ready(slot, message)
            case Answer():
                self._store(slot.jobs.pop(message.number), message)
            case Fault():
                raise RuntimeError(message.reason) if message.is_fault else WorkerError(message.reason)
            case Died():
                del self._slots[number]
                self._handle_death(slot, message.reason)
                self._add()
        self._distribute()

    def _set_ready(self, slot: _Slot, identity: Identity) -> None:
        if self._identity not in (None, identity):
            raise WorkerError(
                f"the workers' detectors differ: {identity} and {self._identity}; set --backend to one that all "
                "machines have, and install the same packages on them"
            )
        slot.is_ready, self._identity, self._failed_starts = True, identity, 0

    def _store(self, job: _Job, answer: Answer) -> None:
        if job.split is None:
            self._answers.append(replace(answer, number=job.task.number))
            return
        split = job.split
        split.answers[job.index] = answer.frames[0]
        if len(split.answers) == len(split.task.frames):
            frames = tuple(split.answers[index] for index in range(len(split.task.frames)))
            self._answers.append(Answer(split.task.number, frames))

    def _handle_death(self, slot: _Slot, reason: str) -> None:
        if not slot.is_ready:
            self._failed_starts += 1
            if self._failed_starts >= MAX_FAILED_STARTS:
                raise WorkerError(
                    f"{self._failed_starts} workers in a row have ended before they were ready, the last one {reason}; "
                    "use fewer --workers, or --engine inline"
                )
        for job in slot.jobs.values():
            job.deaths += 1
            if job.deaths < MAX_DEATHS:
                self._suspects.append(job)
            elif len(job.task.frames) == 1:
                message = f"a worker has ended {MAX_DEATHS} times on this frame, the last time {reason}"
                self._store(job, Answer(job.task.number, (FrameAnswer(None, message, 0.0),)))
            else:
                split = _Split(job.task)
                for index, frame in enumerate(job.task.frames):
                    single = replace(job.task, frames=(frame,))
                    # one more death, with this frame alone, is the last
                    self._suspects.append(_Job(single, MAX_DEATHS - 1, split, index))

    def _add(self) -> None:
        self._workers_made += 1
        worker = self._make(self._workers_made, lambda number, message: self._events.put((number, message)))
        self._slots[self._workers_made] = _Slot(worker)

    def _distribute(self) -> None:
        for slot in self._slots.values():
            if not slot.is_ready or slot.has_suspect:
                continue
            if self._suspects:
                # no new tasks until a worker is idle: otherwise a suspect might wait forever
                if not slot.jobs:
                    self._give(slot, self._suspects.popleft())
                continue
            while self._waiting and len(slot.jobs) < TASKS_PER_WORKER:
                self._give(slot, self._waiting.popleft())

    def _give(self, slot: _Slot, job: _Job) -> None:
        self._jobs_sent += 1
        slot.jobs[self._jobs_sent] = job
        slot.worker.send(replace(job.task, number=self._jobs_sent))
