"""When detection will want its next frame, so that frames are read for it and not to be dropped.

Reading a frame takes a core a while (12 ms for an RGB-D image pair), which on a small machine the detectors miss. A
source that gives its newest frame whenever it is asked is therefore asked as late as it may be: so that the frame is
there when detection ends, going by how long the last ones took.
"""

from __future__ import annotations

import statistics
import threading
import time
from collections import deque

# Durations that the next one is guessed from.
REMEMBERED = 9
# A frame is asked for this much earlier than it should be: a wait for it would cost more than its age, seconds.
SPARE_S = 0.003


class Demand:
    """Shared by the thread that reads and the one that detects."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._durations_s: deque[float] = deque(maxlen=REMEMBERED)
        self._reads_s: deque[float] = deque(maxlen=REMEMBERED)
        self._begun_s: float | None = None
        self._is_waiting = False
        self._is_closed = False

    def given(self, read_s: float) -> None:
        """A frame was read, in so many seconds, and waits for detection."""
        with self._changed:
            self._is_waiting = True
            self._reads_s.append(read_s)

    def begins(self) -> None:
        """Detection has taken the frame that waited."""
        with self._changed:
            self._is_waiting = False
            self._begun_s = time.perf_counter()
            self._changed.notify_all()

    def ends(self) -> None:
        """Detection is done with it."""
        with self._changed:
            if self._begun_s is not None:
                self._durations_s.append(time.perf_counter() - self._begun_s)
            self._begun_s = None
            self._changed.notify_all()

    def close(self) -> None:
        """Nobody waits any more."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def wait(self) -> None:
        """Returns when the next frame should be read."""
        with self._changed:
            while not self._is_closed and (left_s := self._left_s()) > 0:
                self._changed.wait(None if left_s == float("inf") else left_s)

    def _left_s(self) -> float:
        """How long until the next frame should be read, seconds; infinite while one waits to be taken."""
        if self._is_waiting:
            return float("inf")
        if self._begun_s is None or not self._durations_s:
            return 0.0
        ends_s = self._begun_s + statistics.median(self._durations_s)
        return ends_s - statistics.median(self._reads_s or [0.0]) - SPARE_S - time.perf_counter()
