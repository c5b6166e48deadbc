"""How a live session is told to end, so that what it recorded is kept."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType


class Interrupts:
    """While it is entered, SIGTERM (`kill`, a service manager, a container that is stopped) ends a session as Ctrl-C
    does: by a KeyboardInterrupt.

    Once the session is ending, further SIGTERMs change nothing: what was recorded is being stored. Ctrl-C goes on to
    interrupt even that: whoever presses it again means it.
    """

    def __init__(self) -> None:
        self._is_ending = self._is_held = False
        self._noted: int | None = None
        self._before: dict[int, signal._HANDLER] = {}

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():  # no other one may ask for signals
            self._before = {number: signal.signal(number, self._handle) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for number, before in self._before.items():
            signal.signal(number, before if before is not None else signal.SIG_DFL)

    @contextmanager
    def ended_by(self) -> Iterator[None]:
        """What is done here is the session: when it is over, however that came, the session is ending."""
        try:
            yield
        finally:
            self._is_ending = True

    @contextmanager
    def held(self) -> Iterator[None]:
        """What is done here is not interrupted in the middle, but at its end."""
        self._is_held = True
        try:
            yield
        finally:
            self._is_held = False
            if self._noted is not None:
                self._handle(self._noted, None)

    def _handle(self, number: int, stack: FrameType | None) -> None:
        if self._is_held:
            self._noted = number
            return
        is_new, self._is_ending = not self._is_ending, True
        if is_new or number == signal.SIGINT:
            raise KeyboardInterrupt
