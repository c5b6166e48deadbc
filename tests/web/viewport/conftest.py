"""A workbench of one's own, without the application around it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from annotator.web.viewport.workbench import Workbench


class Told(list[dict[str, Any]]):
    """The events that a workbench has sent."""

    def of(self, event: str) -> list[dict[str, Any]]:
        return [message for message in self if message["event"] == event]


@pytest.fixture
def told() -> Told:
    return Told()


@pytest.fixture
def bench(told: Told) -> Iterator[Workbench]:
    """A real viser server that nobody looks at."""
    made = Workbench("0123456789abcdef", "Ada", "room", lambda bench, message: told.append(message))
    yield made
    made.close()
