"""What tests in a real browser have in common; see browser/conftest.py for the fixtures."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from playwright.sync_api import Page

POLL_MS = 50


def until(page: Page, condition: str | Callable[[], object], seconds: float = 20.0) -> None:
    """Waits for a JavaScript expression, or a function here, to become true.

    `Page.wait_for_function` would evaluate a string within the page, which the page's own policy forbids.
    """
    for _ in range(int(seconds * 1000 / POLL_MS)):
        if condition() if callable(condition) else page.evaluate(condition):
            return
        page.wait_for_timeout(POLL_MS)
    raise AssertionError(f"not within {seconds} s: {condition}")
