"""Pairs of rows of two tables that belong to the same group, for whole datasets at once."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int


def pairs_within(
    groups_a: Int[np.ndarray, "n"], groups_b: Int[np.ndarray, "m"]
) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]]:
    """All pairs of a row of one table and a row of the other in the same group, such as the same frame.

    Args:
        groups_a, groups_b: the group of each row, any integers.

    Returns:
        indices into both, ordered by the first and then by the second.
    """
    order = np.argsort(groups_b, kind="stable")
    ordered = groups_b[order]
    begin = np.searchsorted(ordered, groups_a, side="left")
    count = np.searchsorted(ordered, groups_a, side="right") - begin
    rows = np.repeat(np.arange(len(groups_a)), count)
    return rows, order[np.repeat(begin, count) + place_within(rows)]


def place_within(groups: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """The position of each row within its group, from 0; the rows of a group must be adjacent."""
    if len(groups) == 0:
        return np.zeros(0, np.int64)
    starts = np.flatnonzero(np.concatenate([[True], groups[1:] != groups[:-1]]))
    return np.arange(len(groups)) - np.repeat(starts, np.diff(np.append(starts, len(groups))))
