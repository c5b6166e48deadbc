"""How long a thread waits for a database that another process has locked."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_AT_MOST_S: ContextVar[float] = ContextVar("annotator_waits_at_most_s", default=float("inf"))


@contextmanager
def waiting_at_most(seconds: float) -> Iterator[None]:
    """Within the block, this thread waits no longer than this for any locked database.

    For code that serves several projects in turn, so that a locked one does not hold up the others.
    """
    token = _AT_MOST_S.set(seconds)
    try:
        yield
    finally:
        _AT_MOST_S.reset(token)


def patience_s(usual_s: float) -> float:
    """How long this thread waits, seconds; `usual_s` outside `waiting_at_most`."""
    return min(usual_s, _AT_MOST_S.get())
