"""Who does what: hands tasks to workers, replaces workers that die, and finds out which frames they die of.

A worker holds two tasks: one that it works on, one that it reads meanwhile. When it dies, both come back as suspects. A
suspect goes to a worker that has nothing else, and gets nothing else until it is done: so whoever dies then dies of it.
What kills a second time is split into its frames, and a frame that kills a worker again has failed.
"""

from __future__ import annotations

import logging
import queue
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from annotator.types.errors import WorkerError
from annotator.workflows.engines.events import Died, Done, Event, Ready, Refused, Tell, Worker
from annotator.workflows.engines.tasks import Answer, FrameAnswer, Identity, Task

LOG = logging.getLogger("annotator.engines")

# Tasks that a worker holds: one at work, one being read.
HELD = 2
# A task that has killed so many workers is split; a single frame has failed.
MOST_DEATHS = 2
# So many workers in a row that die before they are ready: the next one would, too.
MOST_STILLBORN = 3
# Where no worker is ready, whoever waits is told again after so long. Loading takes some seconds.
TOLD_EVERY_S = 30.0


Make = Callable[[int, Tell], Worker]
"""Makes the worker of that number."""


@dataclass(eq=False)
class _Job:
    """A task on its way, or one frame of it."""

    task: Task
    deaths: int = 0
    whole: _Split | None = None
    at: int = 0


@dataclass(eq=False)
class _Split:
    """A task whose frames go alone."""

    task: Task
    answers: dict[int, FrameAnswer] = field(default_factory=dict)


@dataclass(eq=False)
class _Hand:
    """A worker, and what it has."""

    worker: Worker
    is_ready: bool = False
    jobs: dict[int, _Job] = field(default_factory=dict)

    @property
    def is_alone_with_a_suspect(self) -> bool:
        return any(job.deaths for job in self.jobs.values())


class WorkerPool:
    """An engine of some workers, wherever they are."""

    def __init__(self, make: Make, workers: int) -> None:
        """
        Args:
            make: makes a worker, which begins to load at once.
            workers: how many there are at any time.
        """
        self._make, self._workers = make, workers
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._hands: dict[int, _Hand] = {}
        self._waiting: deque[_Job] = deque()
        self._suspects: deque[_Job] = deque()
        self._answers: deque[Answer] = deque()
        self._identity: Identity | None = None
        self._numbers = 0
        self._made = self._stillborn = 0

    @property
    def window(self) -> int:
        # one more a worker: while the oldest is waited for, the others go on
        return self._workers * (HELD + 1)

    def start(self) -> Identity:
        """Starts the workers; comes back when the first is ready. The log says so where that takes long.

        Raises:
            AnnotatorError: the detectors cannot be loaded.
            WorkerError: workers die before they are ready.
        """
        while len(self._hands) < self._workers:
            self._add()
        begin = time.monotonic()
        while self._identity is None:
            try:
                self._take(self._events.get(timeout=TOLD_EVERY_S))
            except queue.Empty:
                LOG.warning(
                    "none of the %d workers is ready after %.0f s; on a cluster they begin when others free its cores",
                    self._workers,
                    time.monotonic() - begin,
                )
        return self._identity

    def start_all(self) -> Identity:
        """The same, and waits until all workers are ready.

        Raises:
            AnnotatorError: as `start`.
        """
        identity = self.start()
        while not all(hand.is_ready for hand in self._hands.values()):
            self._take(self._events.get())
        return identity

    def submit(self, task: Task) -> None:
        """Takes a task."""
        self._waiting.append(_Job(task))
        self._hand_out()

    def wait(self, timeout_s: float) -> Answer | None:
        """The next answer; None where there is none yet after so long.

        Raises:
            WorkerError: workers die before they are ready.
        """
        if not self._answers:
            try:
                self._take(self._events.get(timeout=timeout_s))
            except queue.Empty:
                return None
        return self._answers.popleft() if self._answers else None

    def close(self) -> None:
        """Ends all workers, at once."""
        hands, self._hands = self._hands, {}
        for hand in hands.values():
            hand.worker.end()

    # --- events ------------------------------------------------------------------------------------------------------

    def _take(self, event: Event) -> None:
        hand = self._hands.get(event.worker)
        if hand is None:  # it was given up
            return
        match event:
            case Ready():
                self._welcome(hand, event.identity)
            case Done():
                self._store(hand.jobs.pop(event.answer.number), event.answer)
            case Refused():
                raise RuntimeError(event.reason) if event.is_fault else WorkerError(event.reason)
            case Died():
                del self._hands[event.worker]
                self._bury(hand, event.reason)
                self._add()
        self._hand_out()

    def _welcome(self, hand: _Hand, identity: Identity) -> None:
        if self._identity not in (None, identity):
            raise WorkerError(
                f"the workers' detectors differ: {identity} and {self._identity}; name the --backend that all machines "
                "have, and install the same packages on them"
            )
        hand.is_ready, self._identity, self._stillborn = True, identity, 0

    def _store(self, job: _Job, answer: Answer) -> None:
        if job.whole is None:
            self._answers.append(replace(answer, number=job.task.number))
            return
        split = job.whole
        split.answers[job.at] = answer.frames[0]
        if len(split.answers) == len(split.task.frames):
            frames = tuple(split.answers[at] for at in range(len(split.task.frames)))
            self._answers.append(Answer(split.task.number, frames))

    def _bury(self, hand: _Hand, reason: str) -> None:
        if not hand.is_ready:
            self._stillborn += 1
            if self._stillborn >= MOST_STILLBORN:
                raise WorkerError(
                    f"{self._stillborn} workers in a row have ended before they were ready, the last one {reason}; "
                    "take fewer --workers, or --engine inline"
                )
        for job in hand.jobs.values():
            job.deaths += 1
            if job.deaths < MOST_DEATHS:
                self._suspects.append(job)
            elif len(job.task.frames) == 1:
                told = f"a worker has ended {MOST_DEATHS} times over this frame, the last time {reason}"
                self._store(job, Answer(job.task.number, (FrameAnswer(None, told, 0.0),)))
            else:
                split = _Split(job.task)
                for at, frame in enumerate(job.task.frames):
                    alone = replace(job.task, frames=(frame,))
                    # what it did in company counts as once
                    self._suspects.append(_Job(alone, MOST_DEATHS - 1, split, at))

    def _add(self) -> None:
        self._made += 1
        self._hands[self._made] = _Hand(self._make(self._made, self._events.put))

    def _hand_out(self) -> None:
        for hand in self._hands.values():
            if not hand.is_ready or hand.is_alone_with_a_suspect:
                continue
            if self._suspects:
                # nobody gets anything new until somebody has nothing: else a suspect might wait for ever
                if not hand.jobs:
                    self._give(hand, self._suspects.popleft())
                continue
            while self._waiting and len(hand.jobs) < HELD:
                self._give(hand, self._waiting.popleft())

    def _give(self, hand: _Hand, job: _Job) -> None:
        self._numbers += 1
        hand.jobs[self._numbers] = job
        hand.worker.send(replace(job.task, number=self._numbers))
