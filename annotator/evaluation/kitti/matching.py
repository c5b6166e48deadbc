"""The devkit's greedy assignment of detections to true boxes, for all frames and all score thresholds at once.

In each frame, the true boxes are processed in the order of the file. Each takes its preferred detection among the
remaining ones. The order of preference is independent of earlier assignments and of the score threshold, which only
removes detections. So each true box has a fixed list of candidates, and all frames and thresholds are processed in
parallel: the first candidate of each frame's first box, then its second candidate, and so on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int, Shaped

from annotator.evaluation.pairs import place_within


@dataclass(frozen=True, eq=False)
class Assignment:
    """The result of the assignment, with one column per threshold.

    Attributes:
        pair: whether each pair was assigned.
        truth: whether each true row got a detection.
        detection: whether each detection was taken.
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
    """Assigns detections to true rows.

    Args:
        truth, detection: row indices of the pairs that overlap enough, from 0. The true rows of a frame are processed
            in the order of their indices.
        frame: frame of each pair.
        preference: sort keys of each true row's candidates, smallest first; the first array is the primary key.
        usable: whether the pair's detection passes each threshold.
    """
    columns = usable.shape[1]
    pair = np.zeros((len(truth), columns), bool)
    served = np.zeros((truth.max(initial=-1) + 1, columns), bool)
    taken = np.zeros((detection.max(initial=-1) + 1, columns), bool)
    for step in _steps(truth, frame, preference):
        # one true row per frame, so no detection occurs twice in a step
        row, candidate = truth[step], detection[step]
        assigned = usable[step] & ~served[row] & ~taken[candidate]
        pair[step] = assigned
        served[row] |= assigned
        taken[candidate] |= assigned
    return Assignment(pair, served, taken)


def _steps(
    truth: Int[np.ndarray, "p"], frame: Int[np.ndarray, "p"], preference: Sequence[Shaped[np.ndarray, "p"]]
) -> list[Int[np.ndarray, "k"]]:
    """The pairs that are processed together, step by step."""
    order = np.lexsort((*reversed(preference), truth, frame))
    place = place_within(truth[order])
    # the position of each true row within its frame, counting only rows with a candidate
    first = np.flatnonzero(place == 0)
    row_in_frame = np.repeat(place_within(frame[order][first]), np.diff(np.append(first, len(order))))
    by_step = np.lexsort((place, row_in_frame))
    row_in_frame, place = row_in_frame[by_step], place[by_step]
    changes = np.flatnonzero((np.diff(row_in_frame) != 0) | (np.diff(place) != 0)) + 1
    return [part for part in np.split(order[by_step], changes) if len(part)]
