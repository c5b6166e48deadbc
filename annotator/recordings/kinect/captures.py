"""Pairs the colour and depth images of an Azure Kinect recording by time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from annotator.recordings.kinect.matroska import Block, MatroskaIndex, Track

DEFAULT_PERIOD_NS = 33_333_333


@dataclass(frozen=True, eq=False)
class Capture:
    """The images of one moment; `depth` is None if the file ends before it."""

    color: Block
    depth: Block | None


def find_captures(index: MatroskaIndex, color: Track, depth: Track, delay_ns: int) -> dict[int, Capture]:
    """Pairs each colour image with the nearest depth image within half a period; by the colour image's number."""
    colors = [block for block in index.blocks if block.track == color.number]
    depths = [block for block in index.blocks if block.track == depth.number]
    within_ns = (color.period_ns or depth.period_ns or DEFAULT_PERIOD_NS) // 2
    times = np.array([block.time_ns - delay_ns for block in depths], np.int64)
    order = np.argsort(times, kind="stable")
    captures: dict[int, Capture] = {}
    for number, block in enumerate(colors):
        nearest = _nearest(times, order, block.time_ns)
        if nearest is not None and abs(int(times[nearest]) - block.time_ns) < within_ns:
            captures[number] = Capture(block, depths[nearest])
        elif index.is_truncated and block is colors[-1]:
            captures[number] = Capture(block, None)
    return captures


def _nearest(times: np.ndarray, order: np.ndarray, time_ns: int) -> int | None:
    """Returns the index of the time nearest to `time_ns`; `order` sorts `times`."""
    if len(times) == 0:
        return None
    after = int(np.searchsorted(times, time_ns, sorter=order))
    around = order[max(after - 1, 0) : after + 1]
    return int(around[np.argmin(np.abs(times[around] - time_ns))])
