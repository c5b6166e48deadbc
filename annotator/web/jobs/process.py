"""One worker process: started, listened to, stopped."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from pydantic import ValidationError

from annotator.web.jobs.messages import SAID, STOP, Order, Said

LOG = logging.getLogger("annotator.web")

# Asked to stop, work comes to a good end within a batch; what takes longer hangs.
GRACE_S, KILL_AFTER_S = 15.0, 5.0


class WorkerProcess:
    """A worker with its order. Nothing is lost when it is killed: the store keeps whole changes only."""

    def __init__(self, order: Order, log: Path) -> None:
        self._timers: list[threading.Timer] = []
        with log.open("wb") as errors:
            self._process = subprocess.Popen(
                # -P: a file in the current folder never stands in for a module
                [sys.executable, "-P", "-m", "annotator.web.jobs.worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                encoding="utf-8",
                # waiting threads shall not spin on the cores that the server needs
                env={**os.environ, "OMP_WAIT_POLICY": "PASSIVE"},
                # an interrupt at the terminal is for the server, which stops its workers itself
                start_new_session=True,
            )
        self._write(order.model_dump_json() + "\n")

    @property
    def pid(self) -> int:
        """The process's id."""
        return self._process.pid

    def said(self) -> Iterator[Said]:
        """What the worker says, until it has ended."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            try:
                yield SAID.validate_json(line)
            except ValidationError:
                LOG.warning("a worker said something odd: %s", line[:200])
        self._process.wait()
        for timer in self._timers:
            timer.cancel()
        self._process.stdout.close()
        with suppress(BrokenPipeError):
            assert self._process.stdin is not None
            self._process.stdin.close()

    @property
    def exit_code(self) -> int | None:
        """Negative: the signal that ended it; None while it runs."""
        return self._process.poll()

    def stop(self, grace_s: float = GRACE_S) -> None:
        """Asks it to stop; after `grace_s` it is terminated, and in the end killed."""
        self._write(STOP)
        self._later(grace_s, signal.SIGTERM)
        self._later(grace_s + KILL_AFTER_S, signal.SIGKILL)

    def _later(self, seconds: float, what: signal.Signals) -> None:
        timer = threading.Timer(seconds, self._signal, (what,))
        timer.daemon = True
        self._timers.append(timer)
        timer.start()

    def _signal(self, what: signal.Signals) -> None:
        with suppress(ProcessLookupError):
            # its whole session, which is its own
            if self._process.poll() is None:
                os.killpg(self._process.pid, what)

    def _write(self, text: str) -> None:
        assert self._process.stdin is not None
        # a worker that has ended already says so itself
        with suppress(BrokenPipeError, ValueError):
            self._process.stdin.write(text)
            self._process.stdin.flush()
