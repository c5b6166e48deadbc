"""Track ids: given ids are kept, and ids of an earlier linking are reused."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence


def numbered(given: Sequence[int | None], before: Sequence[Sequence[int]], first: int = 1) -> list[int]:
    """An id for each track, for those of its boxes that have none from an operator or a file; all are unique.

    So a box never gets the given id of another object, which may be in the same frame.

    Args:
        given: the id of each track from an operator or a file, or None. One that several tracks have, such as a
            person and a chair, is the id of neither.
        before: the ids of each track's boxes from an earlier linking. A track reuses its most frequent id. If
            several tracks compete for an id, the one with the most boxes of this id gets it.
        first: the lowest new id.
    """
    used = {number for number in given if number is not None}
    times = Counter(given)
    given = [None if times[number] > 1 else number for number in given]
    candidates = [
        (count, -place, number)
        for place, numbers in enumerate(before)
        if given[place] is None
        for number, count in Counter(numbers).items()
    ]
    ids: dict[int, int] = {}
    for _, negative_place, number in sorted(candidates, reverse=True):
        if -negative_place not in ids and number not in used:
            ids[-negative_place] = number
            used.add(number)
    fresh = max([first - 1, *used])
    for place, given_id in enumerate(given):
        if given_id is not None:
            ids[place] = given_id
        elif place not in ids:
            fresh += 1
            ids[place] = fresh
    return [ids[place] for place in range(len(given))]
