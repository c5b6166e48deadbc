"""Track ids: given ids stay, and ids of an earlier linking are reused."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence


def numbered(given: Sequence[int | None], before: Sequence[Sequence[int]], first: int = 1) -> list[int]:
    """An id for each track, unique except for given ids.

    Args:
        given: the id that a person or a file has given to each track, or None.
        before: the ids that an earlier linking gave to each track's boxes. The most frequent one is reused, by the
            track with most boxes of this id.
        first: the lowest new id.
    """
    used = {number for number in given if number is not None}
    candidates = [
        (count, -place, number)
        for place, numbers in enumerate(before)
        if given[place] is None
        for number, count in Counter(numbers).items()
    ]
    ids: dict[int, int] = {}
    for _, behind, number in sorted(candidates, reverse=True):
        if -behind not in ids and number not in used:
            ids[-behind] = number
            used.add(number)
    fresh = max([first - 1, *used])
    for place, known in enumerate(given):
        if known is not None:
            ids[place] = known
        elif place not in ids:
            fresh += 1
            ids[place] = fresh
    return [ids[place] for place in range(len(given))]
