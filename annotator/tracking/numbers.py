"""Numbers for tracks: what was given stays, what was found before is found again."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence


def numbered(given: Sequence[int | None], before: Sequence[Sequence[int]], first: int = 1) -> list[int]:
    """A number for each track, unique but for given ones.

    Args:
        given: what somebody has said of each track.
        before: the numbers that an earlier linking gave to each track's boxes; the most frequent one is kept, and goes
            to the track that has most of it.
        first: the lowest number to give out.
    """
    used = {number for number in given if number is not None}
    wishes = [
        (count, -place, number)
        for place, numbers in enumerate(before)
        if given[place] is None
        for number, count in Counter(numbers).items()
    ]
    found: dict[int, int] = {}
    for _, behind, number in sorted(wishes, reverse=True):
        if -behind not in found and number not in used:
            found[-behind] = number
            used.add(number)
    fresh = max([first - 1, *used])
    for place, known in enumerate(given):
        if known is not None:
            found[place] = known
        elif place not in found:
            fresh += 1
            found[place] = fresh
    return [found[place] for place in range(len(given))]
