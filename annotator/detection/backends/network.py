"""What all backends share: their input and output, and how images are distributed over the cores of the CPU.

Each image is computed alone, or in a batch if that gives exactly the same bits. So the output for an image does not
depend on the other images, and a runtime needs few input shapes per canvas size.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float32, UInt8
from pydantic import Field

from annotator.types.bases import Strict

# Input (n, height, width, RGB) and raw prediction (n, 4 + classes + spreads, anchors) with 4 spreads or none; sizes may
# differ from batch to batch.
Batch = UInt8[np.ndarray, "_ _ _ 3"]
Answer = Float32[np.ndarray, "_ _ _"]


class NetworkFacts(Strict):
    """Properties of a network that pre- and post-processing need.

    Attributes:
        stride: height and width of images must be multiples of this, pixels.
        end2end: whether the network predicts each object once, so that no non-maximum suppression is needed.
        edge_spread: whether its last four rows are the spread of each edge (`torch_network.py`), pixels.
    """

    labels: tuple[str, ...] = Field(min_length=1)
    stride: int = Field(ge=1)
    end2end: bool
    edge_spread: bool


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
