"""Room for one item between two threads."""

from __future__ import annotations

import threading
from typing import Generic, TypeVar

Item = TypeVar("Item")


class Slot(Generic[Item]):
    """A newer item takes the place of one that nobody has taken yet. One thread puts, one takes.

    Attributes:
        dropped: items that a newer one has replaced.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._item: Item | None = None
        self._closed = False
        self.dropped = 0

    def put(self, item: Item) -> None:
        """Leaves an item; never waits. After `close` it goes nowhere."""
        with self._changed:
            if self._closed:
                return
            self.dropped += self._item is not None
            self._item = item
            self._changed.notify()

    def take(self) -> Item | None:
        """Waits for an item and takes it; None once the slot is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._item is not None or self._closed)
            item, self._item = self._item, None
            return item

    def close(self, *, empty: bool = False) -> None:
        """Nothing more comes. What is in it may still be taken, unless it is to be emptied."""
        with self._changed:
            self._closed = True
            if empty:
                self._item = None
            self._changed.notify_all()
