"""`python -m annotator.web.jobs.worker`: the process of one job.

The first line of standard input is the order. "pause" holds a job in the background for a moment, at a safe point.
Another line, or the end of standard input, asks the worker to stop, so that it also ends when its server has died.
Messages to the server go to standard output, one per line; the output of libraries goes to standard error.
"""

from __future__ import annotations

import os
import sys
import threading
import time
import traceback
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TextIO

from annotator.project import open_project
from annotator.types.errors import AnnotatorError
from annotator.web.jobs.records import (
    PAUSE,
    Ended,
    JobContext,
    JobState,
    JobStoppedError,
    Order,
    Outcome,
    Progress,
    WorkerMessage,
    in_background,
)

NICENESS, BACKGROUND_NICENESS = 10, 19
# The priority of all processes of a session, where Linux groups them: sched(7), "The autogroup feature".
AUTOGROUP = Path("/proc/self/autogroup")
# Minimum interval between progress messages: a training reports after every batch.
PROGRESS_EVERY_S = 0.2
# A worker exits if it has not stopped this long after its server died.
GIVE_UP_AFTER_S = 20.0
# A job in the background goes on this long after the last "pause".
PAUSE_S = 4.0


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
    writer = MessageWriter(_own_output())
    order = Order.model_validate_json(sys.stdin.readline())
    lower_priority(BACKGROUND_NICENESS if in_background(order.request) else NICENESS)
    orders = Orders()
    threading.Thread(target=_read_orders, args=(orders,), daemon=True).start()
    run(order, writer.send, orders)
    return 0


def run(order: Order, send: Callable[[WorkerMessage], None], orders: Orders) -> None:
    """Runs a job; the last message tells how it ended."""
    module, _, function = order.target.partition(":")
    try:
        work = getattr(import_module(module), function)
        with open_project(order.project, readable=order.readable) as project:
            outcome: Outcome = work(
                JobContext(project, order.folder, order.operator, send, orders.stopped), order.request
            )
        send(Ended(state=JobState.DONE, message=outcome.message, result=outcome.result))
    except JobStoppedError as error:
        send(Ended(state=JobState.CANCELLED, message=str(error)))
    except AnnotatorError as error:
        send(Ended(state=JobState.FAILED, message=str(error)))
    except Exception:  # reported to the server, which logs it
        send(Ended(state=JobState.FAILED, message=traceback.format_exc(), is_fault=True))


def lower_priority(niceness: int) -> None:
    """Lets other processes go first.

    Where Linux groups processes by session, their niceness counts only within the session. This process has its own
    session, so the niceness of its group is set as well.
    """
    os.nice(niceness)
    if os.getsid(0) != os.getpid():
        return
    for _ in range(10):
        try:
            AUTOGROUP.write_text(str(niceness))
            return
        except BlockingIOError:
            # Linux allows one such change in 0.1 s on the whole machine
            time.sleep(0.1)
        except OSError:
            # this system has no such groups, or does not let them be changed, as some containers
            return


class Orders:
    """The server's orders to the running job. Thread-safe."""

    def __init__(self) -> None:
        self._stop, self._paused_until_s = threading.Event(), 0.0

    def take(self, line: str) -> None:
        """Takes an order; the end of the input is an order to stop."""
        if line == PAUSE:
            self._paused_until_s = time.monotonic() + PAUSE_S
        else:
            self._stop.set()

    def stopped(self) -> bool:
        """True once a stop was ordered; waits while the job is paused."""
        while (left_s := self._paused_until_s - time.monotonic()) > 0 and not self._stop.is_set():
            self._stop.wait(left_s)
        return self._stop.is_set()


def _own_output() -> TextIO:
    """Reserves standard output for messages; other prints are redirected to standard error."""
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return out


def _read_orders(orders: Orders) -> None:
    while (line := sys.stdin.readline()) == PAUSE:
        orders.take(line)
    orders.take(line)
    if not line:
        time.sleep(GIVE_UP_AFTER_S)
        os._exit(1)


if __name__ == "__main__":
    sys.exit(main())
