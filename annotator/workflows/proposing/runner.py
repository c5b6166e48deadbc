"""How every engine runs a task, and the engine without worker processes."""

from __future__ import annotations

import threading
import time
import traceback
from collections import deque
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

from annotator.rcv.config import Orientation, RcvConfig
from annotator.rcv.propose import propose
from annotator.types import Frame
from annotator.types.errors import AnnotatorError
from annotator.workflows.detectors import Detectors
from annotator.workflows.frame_source import orientation_for
from annotator.workflows.proposing.pool import WorkerPool
from annotator.workflows.proposing.tasks import (
    MAX_OPEN,
    Answer,
    DetectorSource,
    FrameAnswer,
    FrameSpec,
    Identity,
    Storage,
    Task,
    pickle_exactly,
)

_Read = tuple[int, FrameSpec, Frame, float]
"""A frame in memory, with its index in the task, its description, and the time to read it."""


class TaskRunner:
    """Runs tasks with a pair of detectors.

    Two threads may share it: one reads the next task's frames while the other one proposes.
    """

    def __init__(self, detectors: Detectors, storage: Storage) -> None:
        # answers may be pickled for another process, which must not change them
        pickle_exactly()
        self.detectors = detectors
        self._open = lru_cache(MAX_OPEN)(storage.open)
        self._reading, self._proposing = threading.Lock(), threading.Lock()

    @property
    def identity(self) -> Identity:
        pair = self.detectors
        return Identity(pair.image.fingerprint, pair.view.fingerprint, pair.backends, pair.kinds)

    def do(self, task: Task) -> Answer:
        """Runs a task. Every exception becomes the answer of its frame, so that one frame cannot end a long batch."""
        answers: dict[int, FrameAnswer] = {}
        with self._reading:
            read = self._read_all(task, answers)
        with self._proposing:
            for orientation in Orientation:
                same = [each for each in read if orientation_for(task.rotation, each[2]) is orientation]
                if same:
                    self._propose(same, task.config.model_copy(update={"orientation": orientation}), answers)
        return Answer(task.number, tuple(answers[index] for index in range(len(task.frames))))

    def _read_all(self, task: Task, answers: dict[int, FrameAnswer]) -> list[_Read]:
        read: list[_Read] = []
        for index, spec in enumerate(task.frames):
            begin = time.perf_counter()
            try:
                frame = self._open(spec.recording, task.project).read(spec.key)
            except Exception as error:
                answers[index] = failure(error, time.perf_counter() - begin)
            else:
                read.append((index, spec, frame, time.perf_counter() - begin))
        return read

    def _propose(self, read: Sequence[_Read], config: RcvConfig, answers: dict[int, FrameAnswer]) -> None:
        begin = time.perf_counter()
        try:
            seeds = [spec.seeds for _, spec, _, _ in read]
            pair, frames = self.detectors, [frame for _, _, frame, _ in read]
            results = propose(frames, pair.image, pair.view, config, seeds if any(seeds) else None)
        except Exception as error:
            if len(read) == 1:
                ((index, _, _, seconds),) = read
                answers[index] = failure(error, seconds + time.perf_counter() - begin)
            else:  # one by one, so that only the faulty frame fails
                for one in read:
                    self._propose([one], config, answers)
            return
        each_s = (time.perf_counter() - begin) / len(read)
        for (index, _, _, seconds), result in zip(read, results, strict=True):
            answers[index] = FrameAnswer(result, None, seconds + each_s)


def failure(error: Exception, seconds: float) -> FrameAnswer:
    """Returns the answer of a failed frame; for errors in the program, the reason includes file and line."""
    reason = str(error)
    if not isinstance(error, AnnotatorError):
        place = traceback.extract_tb(error.__traceback__)[-1]
        reason = f"{type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})"
    return FrameAnswer(None, reason, seconds)


class InlineEngine:
    """Runs tasks in this process, one at a time."""

    window = 1

    def __init__(self, source: DetectorSource, threads: int | None = None, storage: Storage | None = None) -> None:
        self._source, self._threads, self._storage = source, threads, storage or Storage()
        self._runner: TaskRunner | None = None
        self._tasks: deque[Task] = deque()

    def start(self) -> Identity:
        """Loads the detectors."""
        return self._ready().identity

    def submit(self, task: Task) -> None:
        """Adds a task."""
        self._tasks.append(task)

    def wait(self, timeout_s: float) -> Answer | None:
        """Runs the oldest task, regardless of `timeout_s`; returns None if there is none."""
        return self._ready().do(self._tasks.popleft()) if self._tasks else None

    def close(self) -> None:
        """Drops the detectors and all tasks."""
        self._runner = None
        self._tasks.clear()

    def _ready(self) -> TaskRunner:
        if self._runner is None:
            self._runner = TaskRunner(self._source.load(self._threads), self._storage)
        return self._runner


Engine = InlineEngine | WorkerPool
"""Takes tasks, and returns their answers in any order; used by one thread. It is closed after use, also after an
exception; tasks without an answer are then lost. Its `window` is the maximum number of tasks in flight, enough to keep
all workers busy."""
