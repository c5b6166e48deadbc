"""What to write in place of a name that is not known."""

from __future__ import annotations

from collections.abc import Collection
from difflib import get_close_matches

# Names that a message lists.
MOST_LISTED = 12


def alternatives(name: str, known: Collection[str]) -> str:
    """For messages: "did you mean 'car'?", or, where no known name is near, "it has: car, van"."""
    near = nearest(name, known)
    if near is not None:
        return f"did you mean {near!r}?"
    listed = list(known)[:MOST_LISTED]
    more = f" and {len(known) - MOST_LISTED} more" if len(known) > MOST_LISTED else ""
    return f"it has: {', '.join(listed) or 'none'}{more}"


def nearest(name: str, known: Collection[str]) -> str | None:
    """The known name that a wrong one probably means; None if none is near."""
    by_fold: dict[str, str] = {}
    for each in known:
        by_fold.setdefault(folded(each), each)
    near = get_close_matches(folded(name), by_fold, 1)
    return by_fold[near[0]] if near else None


def folded(name: str) -> str:
    """A name without what spellings differ in: case, spaces, `-` and `_`."""
    return "".join(c for c in name.casefold() if c not in " -_")
