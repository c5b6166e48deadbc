"""Depth images compressed as RVL: A. D. Wilson, "Fast Lossless Depth Image Compression" (ISS 2017), Figure 3.

A picture is a list of numbers: how many zeros follow, how many depths follow, and each depth as the difference to the
one before. A number is written in groups of three bits, lowest first, each with a fourth bit that says whether another
group follows; eight such groups are a little-endian word, the first one in its highest bits.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt16

from annotator.frame_limits import require_pixels

# columns and rows, which `compressed_depth_image_transport` writes before the words
HEAD_BYTES = 8
LONGEST_NUMBER = 7


def decode_rvl(data: bytes) -> UInt16[np.ndarray, "h w"]:
    """Returns the depths of an RVL picture with its size before it.

    Raises:
        ValueError: it is truncated or damaged.
    """
    width, height = np.frombuffer(data[:HEAD_BYTES], "<u4").tolist() if len(data) >= HEAD_BYTES else (0, 0)
    require_pixels(width, height, give_points=True)
    numbers = _numbers(data[HEAD_BYTES:])
    deltas = np.zeros(width * height, np.int64)
    is_depth = np.zeros(width * height, bool)
    at = pixel = 0
    while pixel < len(deltas):
        if at + 2 > len(numbers):
            raise ValueError("its RVL picture is truncated")
        zeros, depths = int(numbers[at]), int(numbers[at + 1])
        start, end = pixel + zeros, pixel + zeros + depths
        if end > len(deltas) or at + 2 + depths > len(numbers) or end == pixel:
            raise ValueError("its RVL picture is damaged or truncated")
        coded = numbers[at + 2 : at + 2 + depths]
        deltas[start:end] = (coded >> 1) ^ -(coded & 1)
        is_depth[start:end] = True
        at, pixel = at + 2 + depths, end
    return np.where(is_depth, np.cumsum(deltas), 0).astype(np.uint16).reshape(height, width)


def _numbers(data: bytes) -> np.ndarray:
    """Returns all numbers of a stream of words."""
    words = np.frombuffer(data[: len(data) // 4 * 4], "<u4")
    groups = (words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32) & 15).reshape(-1).astype(np.int64)
    ends = np.flatnonzero(groups < 8)
    starts = np.concatenate([[0], ends[:-1] + 1])
    if len(ends) == 0 or (ends - starts).max() > LONGEST_NUMBER:
        raise ValueError("its RVL picture is damaged")
    groups = groups[: ends[-1] + 1]
    place = np.arange(len(groups)) - np.repeat(starts, ends - starts + 1)
    return np.add.reduceat((groups & 7) << 3 * place, starts)
