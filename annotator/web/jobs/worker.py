"""`python -m annotator.web.jobs.worker`: the process of one job.

The first line of standard input is the order. A further line, or the end of standard input, asks the worker to stop, so
that it also ends when its server has died. Messages to the server go to standard output, one per line; the output of
libraries goes to standard error.
"""

from __future__ import annotations

import os
import sys
import threading
import time
import traceback
from importlib import import_module
from typing import TextIO

from annotator.project import open_project
from annotator.types.errors import AnnotatorError
from annotator.web.jobs.job_context import JobContext, JobStoppedError, Outcome
from annotator.web.jobs.messages import Failed, Finished, Order, Progress, Stopped, WorkerMessage

NICENESS = 5
# Minimum interval between progress messages: a training reports after every batch.
PROGRESS_EVERY_S = 0.2
# A worker exits if it has not stopped this long after its server died.
GIVE_UP_AFTER_S = 20.0


class MessageWriter:
    """Writes messages to the server. Thread-safe."""

    def __init__(self, out: TextIO) -> None:
        self._out = out
        self._lock = threading.Lock()
        self._last_s, self._stage = 0.0, ""

    def send(self, message: WorkerMessage) -> None:
        """Writes one line; drops frequent progress messages within the same stage."""
        with self._lock:
            if isinstance(message, Progress):
                now = time.monotonic()
                is_recent = now - self._last_s < PROGRESS_EVERY_S
                if message.stage == self._stage and is_recent and message.done < message.total:
                    return
                self._last_s, self._stage = now, message.stage
            try:
                self._out.write(message.model_dump_json() + "\n")
                self._out.flush()
            except (BrokenPipeError, ValueError):
                # the server has died; the end of standard input stops the work
                return


def main() -> int:
    """Runs the job and reports its end to the server; returns the exit code."""
    os.nice(NICENESS)
    writer = MessageWriter(_own_output())
    order = Order.model_validate_json(sys.stdin.readline())
    stopped = threading.Event()
    threading.Thread(target=_wait_for_stop, args=(stopped,), daemon=True).start()
    try:
        outcome = _work(order, writer, stopped)
        writer.send(Finished(message=outcome.message, result=outcome.result))
    except JobStoppedError as error:
        writer.send(Stopped(message=str(error)))
    except AnnotatorError as error:
        writer.send(Failed(message=str(error), is_fault=False))
    except Exception:  # reported to the server, which logs it
        writer.send(Failed(message=traceback.format_exc(), is_fault=True))
    return 0


def _work(order: Order, writer: MessageWriter, stopped: threading.Event) -> Outcome:
    module, _, function = order.target.partition(":")
    work = getattr(import_module(module), function)
    with open_project(order.project) as project:
        outcome: Outcome = work(JobContext(project, order.folder, writer.send, stopped.is_set), order.request)
        return outcome


def _own_output() -> TextIO:
    """Reserves standard output for messages; other prints are redirected to standard error."""
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return out


def _wait_for_stop(stopped: threading.Event) -> None:
    line = sys.stdin.readline()
    stopped.set()
    if not line:
        time.sleep(GIVE_UP_AFTER_S)
        os._exit(1)


if __name__ == "__main__":
    sys.exit(main())
