"""Words for people: numbers of things, names like an unknown one, and pydantic's errors."""

from __future__ import annotations

from collections.abc import Collection
from difflib import get_close_matches
from itertools import islice
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic import ValidationError


def amount(number: int, noun: str, plural: str = "") -> str:
    """A number with its noun: "1 box", "3 boxes".

    Args:
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


# Kinds of errors whose message names a class of the program.
_NAMING_A_CLASS = ("model_type", "model_attributes_type", "dataclass_type", "is_instance_of")


def first_problem(error: ValidationError, *within: str | int) -> str:
    """Returns the first problem in one line, after its place: "annotations.3.bbox: Field required"."""
    first = error.errors(include_url=False, include_context=False)[0]
    where = ".".join(map(str, (*within, *first["loc"])))
    # pydantic prefixes the messages of custom validators
    problem = first["msg"].removeprefix("Value error, ")
    if first["type"] in _NAMING_A_CLASS:
        problem = "Input should be an object with named fields"
    return f"{where}: {problem}" if where else problem
