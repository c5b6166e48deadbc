"""One worker process: start, messages, stop."""

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

from annotator.files import make_private
from annotator.web.jobs.messages import PAUSE, RESUME, STOP, WORKER_MESSAGE, Order, WorkerMessage

LOG = logging.getLogger("annotator.web")

# Work stops at its next batch; a worker that takes longer than this is assumed to hang.
GRACE_S, KILL_AFTER_S = 15.0, 5.0


class WorkerProcess:
    """A worker process with its order. Killing it is safe: the project's database is transactional."""

    def __init__(self, order: Order, log: Path) -> None:
        self._timers: list[threading.Timer] = []
        make_private(log)
        with log.open("wb") as errors:
            self._process = subprocess.Popen(
                # -P: never imports modules from the current folder
                [sys.executable, "-P", "-m", "annotator.web.jobs.worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                encoding="utf-8",
                # waiting OpenMP threads must not occupy the server's cores
                env={**os.environ, "OMP_WAIT_POLICY": "PASSIVE"},
                # Ctrl-C at the terminal goes to the server only, which stops its workers
                start_new_session=True,
            )
        self._write(order.model_dump_json() + "\n")

    @property
    def pid(self) -> int:
        """The process's id."""
        return self._process.pid

    def messages(self) -> Iterator[WorkerMessage]:
        """Yields the worker's messages until it has ended."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            try:
                yield WORKER_MESSAGE.validate_json(line)
            except ValidationError:
                LOG.warning("invalid message from a worker: %s", line[:200])
        self._process.wait()
        for timer in self._timers:
            timer.cancel()
        self._process.stdout.close()
        with suppress(BrokenPipeError):
            assert self._process.stdin is not None
            self._process.stdin.close()

    @property
    def exit_code(self) -> int | None:
        """The exit code, negative for a signal; None while it runs."""
        return self._process.poll()

    def stop(self, grace_s: float = GRACE_S) -> None:
        """Asks the worker to stop; terminates it after `grace_s`, and kills it `KILL_AFTER_S` seconds later."""
        self._write(STOP)
        self._later(grace_s, signal.SIGTERM)
        self._later(grace_s + KILL_AFTER_S, signal.SIGKILL)

    def pause(self, is_paused: bool) -> None:
        """Asks the worker to wait at its next safe point, or to go on."""
        self._write(PAUSE if is_paused else RESUME)

    def _later(self, seconds: float, number: signal.Signals) -> None:
        timer = threading.Timer(seconds, self._signal, (number,))
        timer.daemon = True
        self._timers.append(timer)
        timer.start()

    def _signal(self, number: signal.Signals) -> None:
        with suppress(ProcessLookupError):
            # the worker's session includes its child processes
            if self._process.poll() is None:
                os.killpg(self._process.pid, number)

    def _write(self, text: str) -> None:
        assert self._process.stdin is not None
        # `messages` handles a worker that has ended
        with suppress(BrokenPipeError, ValueError):
            self._process.stdin.write(text)
            self._process.stdin.flush()
