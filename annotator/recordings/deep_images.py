"""Images of more than 8 bits as 8 bits: the numbers of 10 or 12 bits stand in 16 as they are, and look black.

Colours, and grey of image files, keep black at 0, and the lowest usual depth that holds the brightest number is white.
Grey of ROS messages is infrared or thermal light as a rule: from the darkest to the brightest hundredth. The first
images of a recording decide for all of them, so that it does not flicker.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from annotator.recordings.clouds.columns import FIRST, depth_bits, files_like
from annotator.types.errors import FrameError


@dataclass(frozen=True)
class Levels:
    """The numbers that become black and white."""

    low: float
    high: float

    def with_all(self, others: list[Levels]) -> Levels:
        """Returns the levels that hold these and the others."""
        both = [self, *others]
        return Levels(min(each.low for each in both), max(each.high for each in both))


def depth_levels(pixels: np.ndarray) -> Levels:
    """Returns the levels of the lowest depth that holds all pixels: 8, 10, 12, 14 or 16 bits."""
    return Levels(0.0, 2.0 ** depth_bits(float(pixels.max(initial=0))) - 1)


def contrast_levels(pixels: np.ndarray) -> Levels:
    """Returns the levels from the darkest to the brightest hundredth."""
    low, high = np.percentile(pixels, (1, 99))
    return Levels(float(low), float(high))


def eight_bits(pixels: np.ndarray, levels: Levels) -> UInt8[np.ndarray, "..."]:
    """Returns pixels as 8 bits; those of a full depth lose their lower bits."""
    share = 256 / max(levels.high - levels.low + 1, 2)
    return np.clip((pixels - np.float64(levels.low)) * share, 0, 255).astype(np.uint8)


def common_levels(path: Path, pixels: np.ndarray, read: Callable[[Path], np.ndarray]) -> Levels:
    """Returns the levels of an image file: those of the first images of its folder, and its own.

    Args:
        read: returns the pixels of a file; FrameError = it is damaged, which its own frame tells.
    """
    return depth_levels(pixels).with_all(_of_folder(path.parent, path.suffix, path.parent.stat().st_mtime_ns, read))


@lru_cache(maxsize=64)
def _of_folder(folder: Path, suffix: str, changed_ns: int, read: Callable[[Path], np.ndarray]) -> list[Levels]:
    found = []
    for path in files_like(folder / f"any{suffix}")[:FIRST]:
        try:
            pixels = read(path)
        except FrameError:
            continue
        # 8-bit images among them say nothing
        found += [depth_levels(pixels)] if pixels.dtype != np.uint8 else []
    return found
