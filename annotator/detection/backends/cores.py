"""Distributes images over the cores of the CPU.

Each image is computed alone, or in a batch if that gives exactly the same bits. So the output for an image does not
depend on the other images, and a runtime needs few input shapes per canvas size.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import UInt8

from annotator.detection.backends.network import Answer, Batch

Image = UInt8[np.ndarray, "1 _ _ 3"]


def usable_cores() -> int:
    """Number of cores that this process may use; with a restricted CPU affinity, fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):  # not on Windows and macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def side_by_side(images: int, threads: int) -> bool:
    """Whether these images take less time with one core per image than one after another on all cores."""
    return threads > 1 and images > 1 and 4 * images > threads


def single(batches: Sequence[Batch]) -> list[Image]:
    """Splits batches into batches of one image."""
    return [batch[index : index + 1] for batch in batches for index in range(len(batch))]


def rejoined(answers: Iterable[Answer], batches: Sequence[Batch]) -> list[Answer]:
    """Joins the answers for consecutive parts of batches into one answer per batch."""
    remaining = iter(answers)
    whole: list[Answer] = []
    for batch in batches:
        parts: list[Answer] = []
        while sum(len(part) for part in parts) < len(batch):
            parts.append(next(remaining))
        whole.append(np.concatenate(parts))
    return whole
