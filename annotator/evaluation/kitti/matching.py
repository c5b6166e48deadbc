"""Who gets which detection: the devkit's greedy assignment, for all frames and all score thresholds at once.

In every frame the true boxes have their turn in the order of the file. Each takes the detection that it likes best of
those not yet taken. What it likes does not depend on what others took, nor on the score threshold, which only takes
detections away: so it is a queue of candidates that is made once, and the assignment walks all queues in step: first
all frames' first boxes ask their first candidates, at all thresholds, then their second ones, and so on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int, Shaped

from annotator.evaluation.pairs import place_within


@dataclass(frozen=True, eq=False)
class Assignment:
    """What came out, with a column for each threshold.

    Attributes:
        pair: for each pair, whether its truth took its detection.
        truth: for each true row, whether it took any.
        detection: for each detection, whether it was taken.
    """

    pair: Bool[np.ndarray, "p t"]
    truth: Bool[np.ndarray, "g t"]
    detection: Bool[np.ndarray, "d t"]


def assign(
    truth: Int[np.ndarray, "p"],
    detection: Int[np.ndarray, "p"],
    frame: Int[np.ndarray, "p"],
    preference: Sequence[Shaped[np.ndarray, "p"]],
    usable: Bool[np.ndarray, "p t"],
) -> Assignment:
    """Walks the queues.

    Args:
        truth, detection: the two sides of each pair that overlaps enough, row numbers from 0 on. A frame's true rows
            have their turns in the order of their numbers.
        frame: of each pair.
        preference: what each true row prefers, the smallest first, the first column counting most.
        usable: whether the detection of the pair is there at all, at each of the thresholds.
    """
    columns = usable.shape[1]
    pair = np.zeros((len(truth), columns), bool)
    served = np.zeros((truth.max(initial=-1) + 1, columns), bool)
    taken = np.zeros((detection.max(initial=-1) + 1, columns), bool)
    for asking in _steps(truth, frame, preference):
        # one true row a frame, so that no detection is asked twice in a step
        own, wanted = truth[asking], detection[asking]
        gets = usable[asking] & ~served[own] & ~taken[wanted]
        pair[asking] = gets
        served[own] |= gets
        taken[wanted] |= gets
    return Assignment(pair, served, taken)


def _steps(
    truth: Int[np.ndarray, "p"], frame: Int[np.ndarray, "p"], preference: Sequence[Shaped[np.ndarray, "p"]]
) -> list[Int[np.ndarray, "k"]]:
    """The pairs that are looked at together, step after step."""
    order = np.lexsort((*reversed(preference), truth, frame))
    place = place_within(truth[order])
    # the turn of each true row within its frame, counting only rows that have a candidate
    first = np.flatnonzero(place == 0)
    turn = np.repeat(place_within(frame[order][first]), np.diff(np.append(first, len(order))))
    by_step = np.lexsort((place, turn))
    turn, place = turn[by_step], place[by_step]
    changes = np.flatnonzero((np.diff(turn) != 0) | (np.diff(place) != 0)) + 1
    return [part for part in np.split(order[by_step], changes) if len(part)]
