"""The process of one job.

It gets its `Order`, and then orders: "pause" holds a job in the background for a moment, at a safe point; "stop", or no
more orders, asks it to stop, so that it also ends when its server has died. It sends `WorkerMessage`s; what libraries
print goes to standard error.
"""

from __future__ import annotations

import os
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from pathlib import Path

from annotator.child import Pipe, parent
from annotator.project import open_project
from annotator.types.errors import AnnotatorError
from annotator.web.jobs.records import (
    PAUSE,
    STOP,
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
    """Sends messages to the server. Thread-safe."""

    def __init__(self, server: Pipe) -> None:
        self._server = server
        self._lock = threading.Lock()
        self._last_s, self._stage = 0.0, ""

    def send(self, message: WorkerMessage) -> None:
        """Sends a message; drops frequent progress messages within the same stage."""
        with self._lock:
            if isinstance(message, Progress):
                now = time.monotonic()
                is_recent = now - self._last_s < PROGRESS_EVERY_S
                if message.stage == self._stage and is_recent and message.done < message.total:
                    return
                self._last_s, self._stage = now, message.stage
        # if the server has died, the end of its orders stops the work
        with suppress(OSError, ValueError):
            self._server.send(message)


def main() -> None:
    """Runs the job and reports its end to the server."""
    server = parent()
    order: Order = server.receive()
    lower_priority(BACKGROUND_NICENESS if in_background(order.request) else NICENESS)
    orders = Orders()
    threading.Thread(target=_take_orders, args=(server, orders), daemon=True).start()
    run(order, MessageWriter(server).send, orders)


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

    def take(self, order: str) -> None:
        if order == PAUSE:
            self._paused_until_s = time.monotonic() + PAUSE_S
        else:
            self._stop.set()

    def stopped(self) -> bool:
        """True once a stop was ordered; waits while the job is paused."""
        while (left_s := self._paused_until_s - time.monotonic()) > 0 and not self._stop.is_set():
            self._stop.wait(left_s)
        return self._stop.is_set()


def _take_orders(server: Pipe, orders: Orders) -> None:
    try:
        while True:
            orders.take(server.receive())
    except EOFError:
        orders.take(STOP)
        time.sleep(GIVE_UP_AFTER_S)
        os._exit(1)
