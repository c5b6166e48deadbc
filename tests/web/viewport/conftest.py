"""Fixtures: a viewport without the application."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from annotator.web.viewport.viewports import Viewport


class SentEvents(list[dict[str, Any]]):
    """The events that a viewport has sent."""

    def of(self, event: str) -> list[dict[str, Any]]:
        return [message for message in self if message["event"] == event]


@pytest.fixture
def events() -> SentEvents:
    return SentEvents()


@pytest.fixture
def viewport(events: SentEvents) -> Iterator[Viewport]:
    """A viewport with a real viser server, without a browser."""
    viewport = Viewport("0123456789abcdef", "Ada", "room", lambda _, message: events.append(message))
    yield viewport
    viewport.close()
