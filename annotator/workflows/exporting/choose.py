"""What of a project is exported, and how its frames are divided into parts."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

import numpy as np

from annotator.types import ReviewState
from annotator.types.errors import ConfigError
from annotator.types.messages import amount

# Parts become the names of files and folders.
NAME = re.compile(r"[A-Za-z0-9_-]{1,32}")
# Shares may be rounded: 0.33 three times.
SUM_TOLERANCE = 0.015


class SplitBy(StrEnum):
    """The unit that stays in one part: a frame, or a whole recording (whose frames are similar)."""

    FRAMES = "frames"
    RECORDINGS = "recordings"


@dataclass(frozen=True)
class Split:
    """How a dataset is divided.

    Attributes:
        shares: each part's fraction of the frames; the sum is 1.
        by: divide by frames or by whole recordings.
        seed: seed of the random order.
    """

    shares: Mapping[str, float]
    by: SplitBy = SplitBy.FRAMES
    seed: int = 0


def parse_shares(text: str) -> dict[str, float]:
    """Parses shares such as "train=0.8,val=0.2", or ratios such as "train=4,val=1"."""
    shares: dict[str, float] = {}
    for part in text.split(","):
        name, sign, share = (word.strip() for word in part.partition("="))
        try:
            value = float(share)
        except ValueError:
            value = math.nan
        if not sign or not NAME.fullmatch(name) or not (0 < value < math.inf) or name in shares:
            raise ConfigError(
                f"{text!r} is not a valid split: give each part once with its share, as in train=0.8,val=0.2"
            )
        shares[name] = value
    total = sum(shares.values())
    if abs(total - 1) > SUM_TOLERANCE and not all(share.is_integer() for share in shares.values()):
        fitting = ",".join(f"{name}={share / total:.2g}" for name, share in shares.items())
        raise ConfigError(
            f"the shares of the split {text!r} add up to {total:.3g}, not to 1; write {fitting}, or ratios in whole "
            "numbers, as in train=4,val=1"
        )
    return {name: share / total for name, share in shares.items()}


def assign(split: Split, places: Sequence[tuple[str, str]]) -> list[str]:
    """Returns the part of each frame, independent of the order of the frames.

    Args:
        places: each frame's recording and key, all different.
    """
    groups = [(recording,) if split.by is SplitBy.RECORDINGS else (recording, key) for recording, key in places]
    sizes = Counter[tuple[str, ...]](groups)
    if len(sizes) < len(split.shares):
        raise ConfigError(
            f"{amount(len(sizes), split.by.removesuffix('s'))} cannot be divided into "
            f"{amount(len(split.shares), 'part')} ({', '.join(split.shares)}); give fewer parts, or divide by frames"
        )
    missing = {part: share * len(places) for part, share in split.shares.items()}
    names, empty, part_of = sorted(sizes), set(missing), dict[tuple[str, ...], str]()
    for left, place in zip(
        range(len(names), 0, -1), np.random.default_rng(split.seed).permutation(len(names)), strict=True
    ):
        # each to the part that lacks the most frames; every part gets at least one. In the order of the shares: of
        # equal values, max() takes the first, and a set has no fixed order
        candidates = [name for name in missing if name in empty or left > len(empty)]
        part = part_of[names[place]] = max(candidates, key=missing.__getitem__)
        missing[part] -= sizes[names[place]]
        empty.discard(part)
    return [part_of[group] for group in groups]


@dataclass(frozen=True)
class ExportFilter:
    """The labels to export.

    Attributes:
        states: review states; None = the format's default.
        classes: class names; None = all of the project.
        empty_frames: also export frames without such a label, if they are still in their recordings.
        skip_unreadable: leave out frames that cannot be read; otherwise such a frame ends the export with an error.
    """

    states: tuple[ReviewState, ...] | None = None
    classes: tuple[str, ...] | None = None
    recordings: tuple[int, ...] | None = None
    empty_frames: bool = False
    skip_unreadable: bool = False


Pictures = Literal["images", "views", "both"]
