"""Numbers of things in messages."""

from __future__ import annotations

import pytest

from annotator.types.messages import amount, duration


@pytest.mark.parametrize(
    ("number", "words", "text"),
    [
        (0, ("frame",), "0 frames"),
        (1, ("frame",), "1 frame"),
        (2, ("frame",), "2 frames"),
        (1, ("2D box",), "1 2D box"),
        (3, ("2D box",), "3 2D boxes"),
        (2, ("class",), "2 classes"),
        (2, ("match",), "2 matches"),
        (1, ("recording or frame", "recordings or frames"), "1 recording or frame"),
        (2, ("recording or frame", "recordings or frames"), "2 recordings or frames"),
    ],
)
def test_a_noun_follows_its_number(number: int, words: tuple[str, ...], text: str) -> None:
    assert amount(number, *words) == text


@pytest.mark.parametrize(
    ("hours", "text"),
    [
        (0.0, "0 minutes"),
        (0.002, "under 1 minute"),
        (1 / 60, "1 minute"),
        (0.4, "24 minutes"),
        (0.999, "1.0 hours"),
        (12.34, "12.3 hours"),
    ],
)
def test_a_time_below_one_hour_is_in_minutes(hours: float, text: str) -> None:
    assert duration(hours) == text
