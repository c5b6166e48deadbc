"""Numbers of things in messages."""

from __future__ import annotations

from annotator.types.messages import amount, duration


def test_a_noun_follows_its_number() -> None:
    assert [amount(number, "2D box") for number in (0, 1, 3)] == ["0 2D boxes", "1 2D box", "3 2D boxes"]
    assert [amount(2, word) for word in ("frame", "class", "match")] == ["2 frames", "2 classes", "2 matches"]
    assert amount(2, "recording or frame", "recordings or frames") == "2 recordings or frames"


def test_a_time_below_one_hour_is_in_minutes() -> None:
    hours = (0.0, 0.002, 1 / 60, 0.4, 0.999, 12.34)
    texts = ["0 minutes", "under 1 minute", "1 minute", "24 minutes", "1.0 hours", "12.3 hours"]
    assert list(map(duration, hours)) == texts
