"""The worker process of the local engine; `local.py` starts it.

Standard input: a pickled `Start`, then tasks. The worker ends when its input is closed, or when the driver dies.
Standard output: a pickled `Identity`, then answers; or a `Fault` and nothing else. Output of libraries is redirected to
standard error.
"""

from __future__ import annotations

import os
import pickle
import queue
import sys
import threading
import traceback
from typing import BinaryIO

from annotator.workflows.proposing.engines.runner import TaskRunner
from annotator.workflows.proposing.engines.tasks import Task
from annotator.workflows.proposing.pool import Start, fault_of

# One thread proposes while the other one reads frames.
THREADS = 2


class _Output:
    """The pickle stream to the driver. Thread-safe."""

    def __init__(self) -> None:
        self._stream: BinaryIO = os.fdopen(os.dup(1), "wb")
        # redirects what libraries print to standard error
        os.dup2(2, 1)
        self._lock = threading.Lock()

    def send(self, value: object) -> None:
        with self._lock:
            pickle.dump(value, self._stream)
            self._stream.flush()


def main() -> int:
    """Runs tasks until the driver closes the standard input or dies."""
    output = _Output()
    try:
        start: Start = pickle.load(sys.stdin.buffer)
        runner = _runner(start)
        output.send(runner.identity)
    except Exception as error:
        output.send(fault_of(error))
        return 0
    tasks: queue.SimpleQueue[Task] = queue.SimpleQueue()
    for _ in range(THREADS):
        threading.Thread(target=_work, args=(runner, tasks, output), daemon=True).start()
    try:
        while True:
            tasks.put(pickle.load(sys.stdin.buffer))
    except (EOFError, pickle.UnpicklingError):
        # the driver has closed the input or died: unfinished tasks are not needed
        os._exit(0)


def _runner(start: Start) -> TaskRunner:
    import cv2

    if start.threads is not None:
        # OpenCV has no environment variable for it
        cv2.setNumThreads(start.threads)
    return TaskRunner(start.source.load(start.threads), start.storage)


def _work(runner: TaskRunner, tasks: queue.SimpleQueue[Task], output: _Output) -> None:
    try:
        while True:
            output.send(runner.do(tasks.get()))
    except BaseException:
        # TaskRunner.do returns every error as an answer, so this process is broken: end it
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)
