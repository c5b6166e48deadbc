"""Signals that end a live session, handled so that its recording is kept."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType


class Interrupts:
    """A context in which SIGTERM (from `kill`, a service manager or a stopped container) ends a session like Ctrl-C.

    Both raise KeyboardInterrupt. Once the session is ending, further SIGTERMs are ignored, since the recording is being
    stored. A further Ctrl-C interrupts the storing, too.
    """

    def __init__(self) -> None:
        self._is_ending = self._is_deferring = False
        self._deferred: int | None = None
        self._former: dict[int, signal._HANDLER] = {}

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():  # only the main thread may set signal handlers
            self._former = {number: signal.signal(number, self._handle) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for number, former in self._former.items():
            signal.signal(number, former if former is not None else signal.SIG_DFL)

    @contextmanager
    def session(self) -> Iterator[None]:
        """The session itself; when the block is left, the session is ending."""
        try:
            yield
        finally:
            self._is_ending = True

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """Defers a signal to the end of the block."""
        self._is_deferring = True
        try:
            yield
        finally:
            self._is_deferring = False
            if self._deferred is not None:
                self._handle(self._deferred, None)

    def _handle(self, number: int, stack: FrameType | None) -> None:
        if self._is_deferring:
            self._deferred = number
            return
        is_new, self._is_ending = not self._is_ending, True
        if is_new or number == signal.SIGINT:
            raise KeyboardInterrupt
