"""What to write in place of a name that is not known."""

from __future__ import annotations

from collections.abc import Collection
from difflib import get_close_matches
from itertools import islice

# Names that a message lists.
MOST_LISTED = 12


def alternatives(name: str, known: Collection[str]) -> str:
    """For messages: "did you mean 'car'?", or, where no known name is near, "it has: car, van"."""
    near = nearest(name, known)
    if near is not None:
        return f"did you mean {near!r}?"
    return f"it has: {first_few(known, MOST_LISTED) or 'none'}"


def first_few(names: Collection[str], most: int) -> str:
    """The first names of a list, and how many more there are: "a, b, c and 2 more"."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(islice(names, most)) + more


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
