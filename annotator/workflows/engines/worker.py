"""A worker process of the local engine; `local.py` starts it.

Standard input: pickled a `Start`, and then tasks, until it is closed: a worker ends when its driver is gone, whatever
became of it. Standard output: pickled an `Identity` (or a `Fault`, and nothing after it), and then answers. What
libraries print goes to standard error.
"""

from __future__ import annotations

import os
import pickle
import queue
import sys
import threading
import traceback
from typing import BinaryIO

from annotator.workflows.engines.messages import Start, fault_of
from annotator.workflows.engines.runner import TaskRunner
from annotator.workflows.engines.tasks import Task

# One proposes while the other one reads.
THREADS = 2


class _Out:
    """The way back to the driver. Threads share it."""

    def __init__(self) -> None:
        self._stream: BinaryIO = os.fdopen(os.dup(1), "wb")
        # whoever else prints does so to standard error
        os.dup2(2, 1)
        self._lock = threading.Lock()

    def say(self, value: object) -> None:
        with self._lock:
            pickle.dump(value, self._stream)
            self._stream.flush()


def main() -> int:
    """Works until the driver closes the standard input or is gone."""
    out = _Out()
    try:
        start: Start = pickle.load(sys.stdin.buffer)
        runner = _runner(start)
        out.say(runner.identity)
    except Exception as error:
        out.say(fault_of(error))
        return 0
    tasks: queue.SimpleQueue[Task] = queue.SimpleQueue()
    for _ in range(THREADS):
        threading.Thread(target=_work, args=(runner, tasks, out), daemon=True).start()
    try:
        while True:
            tasks.put(pickle.load(sys.stdin.buffer))
    except (EOFError, pickle.UnpicklingError):
        # the driver has closed it, or is gone: nobody wants what the threads are at
        os._exit(0)


def _runner(start: Start) -> TaskRunner:
    import cv2

    if start.threads is not None:
        # OpenCV knows no variable for it
        cv2.setNumThreads(start.threads)
    return TaskRunner(start.source.load(start.threads), start.storage)


def _work(runner: TaskRunner, tasks: queue.SimpleQueue[Task], out: _Out) -> None:
    try:
        while True:
            out.say(runner.do(tasks.get()))
    except BaseException:
        # a task always ends in an answer; where it does not, the process is of no use any more
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)
