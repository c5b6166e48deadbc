"""How backends for the processor share its cores out among pictures.

Pictures are computed by themselves, or together with others where that is known to change nothing: so an answer cannot
depend on what else is asked, and a runtime needs few shapes a canvas.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import UInt8

from annotator.detection.backends.network import Answer, Batch

Picture = UInt8[np.ndarray, "1 _ _ 3"]


def usable_cores() -> int:
    """How many cores this process may use, which is fewer than there are where it has been confined."""
    if hasattr(os, "sched_getaffinity"):  # not on Windows and macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def side_by_side(pictures: int, threads: int) -> bool:
    """Whether so many pictures are done sooner with a core each than one after another on all cores."""
    return threads > 1 and pictures > 1 and 4 * pictures > threads


def single(batches: Sequence[Batch]) -> list[Picture]:
    """The pictures of some batches, each as a batch of its own."""
    return [batch[index : index + 1] for batch in batches for index in range(len(batch))]


def rejoined(answers: Iterable[Answer], batches: Sequence[Batch]) -> list[Answer]:
    """The answers about parts of batches, in order, one answer a batch again."""
    each = iter(answers)
    whole: list[Answer] = []
    for batch in batches:
        parts: list[Answer] = []
        while sum(len(part) for part in parts) < len(batch):
            parts.append(next(each))
        whole.append(np.concatenate(parts))
    return whole
