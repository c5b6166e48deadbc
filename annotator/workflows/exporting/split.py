"""Divides frames into the parts of a dataset, deterministically."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

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
    """Parses shares such as "train=0.8,val=0.2", or ratios such as "train=4,val=1".

    Raises:
        ConfigError: another form, a part that occurs twice, a share that is not positive, or shares (no ratios in whole
            numbers) whose sum is not 1.
    """
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

    Raises:
        ConfigError: there are fewer frames (or recordings) than parts.
    """
    groups: dict[tuple[str, ...], int] = defaultdict(int)
    for recording, key in places:
        groups[(recording,) if split.by is SplitBy.RECORDINGS else (recording, key)] += 1
    if len(groups) < len(split.shares):
        raise ConfigError(
            f"{amount(len(groups), split.by.removesuffix('s'))} cannot be divided into "
            f"{amount(len(split.shares), 'part')} ({', '.join(split.shares)}); give fewer parts, or divide by frames"
        )
    part_of = _randomly_assigned(split, dict(groups))
    return [part_of[(r,) if split.by is SplitBy.RECORDINGS else (r, k)] for r, k in places]


def _randomly_assigned(split: Split, groups: Mapping[tuple[str, ...], int]) -> dict[tuple[str, ...], str]:
    """Assigns the groups in random order, each to the part that lacks the most frames; every part gets at least one."""
    names = sorted(groups)
    order = np.random.default_rng(split.seed).permutation(len(names))
    total = sum(groups.values())
    missing = {part: share * total for part, share in split.shares.items()}
    empty, left = set(missing), len(names)
    part_of: dict[tuple[str, ...], str] = {}
    for place in order:
        # a list in the order of the shares: of equal values, max() takes the first, and a set has no fixed order
        candidates = [name for name in missing if name in empty or left > len(empty)]
        part = max(candidates, key=lambda name: missing[name])
        part_of[names[place]] = part
        missing[part] -= groups[names[place]]
        empty.discard(part)
        left -= 1
    return part_of
