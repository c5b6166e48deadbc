"""Numbers of things in messages for people."""

from __future__ import annotations


def amount(number: int, noun: str, plural: str = "") -> str:
    """A number with its noun: "1 box", "3 boxes".

    Args:
        number: how many there are.
        noun: the word or words for one of them; these may end with the verb, such as "frame has".
        plural: the words for several; default: the noun with s, or with es after x, s and ch.
    """
    if number == 1:
        return f"1 {noun}"
    return f"{number} {plural or noun + ('es' if noun.endswith(('x', 's', 'ch')) else 's')}"


def duration(hours: float) -> str:
    """A time for people: "1.5 hours", or below one hour "24 minutes"."""
    minutes = round(60 * hours)
    if minutes >= 60:
        return f"{hours:.1f} hours"
    return "under 1 minute" if minutes == 0 and hours > 0 else amount(minutes, "minute")
