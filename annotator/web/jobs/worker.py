"""`python -m annotator.web.jobs.worker`: does the one piece of work that its standard input orders.

The first line of the standard input is the order; a further line, or its end, asks to stop: so a worker ends when
its server is gone, whatever became of it. What it has to say goes to the standard output, line by line; what libraries
print goes to standard error.
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
from annotator.web.jobs.desk import Desk, JobStoppedError, Outcome
from annotator.web.jobs.messages import Failed, Finished, Order, Progress, Said, Stopped

NICENESS = 5
# A training says how far it is after every batch; more often than this nobody wants to know.
TELL_EVERY_S = 0.2
# After its server has gone, a worker that does not come to a good end gives up.
GIVE_UP_AFTER_S = 20.0


class Wire:
    """The way back to the server. Threads may share it."""

    def __init__(self, out: TextIO) -> None:
        self._out = out
        self._lock = threading.Lock()
        self._last_s, self._stage = 0.0, ""

    def say(self, message: Said) -> None:
        """One line; progress within the same stage is thinned out."""
        with self._lock:
            if isinstance(message, Progress):
                now = time.monotonic()
                if message.stage == self._stage and now - self._last_s < TELL_EVERY_S and message.done < message.total:
                    return
                self._last_s, self._stage = now, message.stage
            try:
                self._out.write(message.model_dump_json() + "\n")
                self._out.flush()
            except (BrokenPipeError, ValueError):
                # the server is gone; the stop that its end asked for comes to the work by another way
                return


def main() -> int:
    """Does the work; the exit code is 0 whenever its end could be told."""
    os.nice(NICENESS)
    wire = Wire(_own_output())
    order = Order.model_validate_json(sys.stdin.readline())
    stopped = threading.Event()
    threading.Thread(target=_wait_for_stop, args=(stopped,), daemon=True).start()
    try:
        outcome = _work(order, wire, stopped)
        wire.say(Finished(message=outcome.message, result=outcome.result))
    except JobStoppedError as error:
        wire.say(Stopped(message=str(error)))
    except AnnotatorError as error:
        wire.say(Failed(message=str(error), is_fault=False))
    except Exception:  # told to the server, which logs it
        wire.say(Failed(message=traceback.format_exc(), is_fault=True))
    return 0


def _work(order: Order, wire: Wire, stopped: threading.Event) -> Outcome:
    module, _, function = order.target.partition(":")
    work = getattr(import_module(module), function)
    with open_project(order.project) as project:
        outcome: Outcome = work(Desk(project, order.folder, wire.say, stopped.is_set), order.request)
        return outcome


def _own_output() -> TextIO:
    """The standard output for ourselves; whoever else prints there prints to standard error."""
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
