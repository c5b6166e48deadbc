"""Hands frames from one pipeline stage to the next: a slot for one item, and the best moment to read the next frame.

Reading a frame occupies a core for some time (12 ms for an RGB-D image pair), which delays the detectors on a small
machine. So a source that returns its newest frame on request is read as late as possible, such that the frame is ready
when detection ends. Both durations are predicted from recent ones.
"""

from __future__ import annotations

import statistics
import threading
import time
from collections import deque
from typing import Generic, TypeVar

Item = TypeVar("Item")

# Number of recent durations whose median predicts the next one.
HISTORY = 9
# A frame is read this much earlier than predicted, seconds, since a late frame costs more than a slightly older one.
SPARE_S = 0.003


class Slot(Generic[Item]):
    """Holds one item, which a newer one replaces until it is taken. One thread puts, another takes.

    Attributes:
        dropped: number of items replaced before they were taken.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._item: Item | None = None
        self._closed = False
        self.dropped = 0

    def put(self, item: Item) -> None:
        """Puts an item without waiting. Does nothing after `close`."""
        with self._changed:
            if self._closed:
                return
            self.dropped += self._item is not None
            self._item = item
            self._changed.notify()

    def take(self) -> Item | None:
        """Waits for an item and takes it; returns None once the slot is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._item is not None or self._closed)
            item, self._item = self._item, None
            return item

    def close(self, *, empty: bool = False) -> None:
        """Accepts no more items. The present one can still be taken, unless `empty` is set."""
        with self._changed:
            self._closed = True
            if empty:
                self._item = None
            self._changed.notify_all()


class Demand:
    """Predicts when detection needs its next frame. Shared by the reading and the detecting thread."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._durations_s: deque[float] = deque(maxlen=HISTORY)
        self._reads_s: deque[float] = deque(maxlen=HISTORY)
        self._started_s: float | None = None
        self._is_waiting = False
        self._is_closed = False

    def frame_read(self, read_s: float) -> None:
        """Notes that a frame was read in `read_s` seconds and waits for detection."""
        with self._changed:
            self._is_waiting = True
            self._reads_s.append(read_s)

    def detection_begins(self) -> None:
        """Notes that detection has taken the waiting frame."""
        with self._changed:
            self._is_waiting = False
            self._started_s = time.perf_counter()
            self._changed.notify_all()

    def detection_ends(self) -> None:
        """Notes that detection is finished."""
        with self._changed:
            if self._started_s is not None:
                self._durations_s.append(time.perf_counter() - self._started_s)
            self._started_s = None
            self._changed.notify_all()

    def close(self) -> None:
        """Makes `wait` return at once, now and later."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def wait(self) -> None:
        """Returns when the next frame should be read."""
        with self._changed:
            while not self._is_closed and (left_s := self._left_s()) > 0:
                self._changed.wait(None if left_s == float("inf") else left_s)

    def _left_s(self) -> float:
        """Returns the time until the next frame should be read, seconds; infinite while a frame waits."""
        if self._is_waiting:
            return float("inf")
        if self._started_s is None or not self._durations_s:
            return 0.0
        ends_s = self._started_s + statistics.median(self._durations_s)
        return ends_s - statistics.median(self._reads_s or [0.0]) - SPARE_S - time.perf_counter()
