"""Dividing frames into the parts of a dataset, the same way every time."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from annotator.types.errors import ConfigError

# Parts become the names of files and folders.
NAME = re.compile(r"[A-Za-z0-9_-]{1,32}")


class SplitBy(StrEnum):
    """What is never divided: a frame, or a whole recording (whose frames resemble each other)."""

    FRAMES = "frames"
    RECORDINGS = "recordings"


@dataclass(frozen=True)
class Split:
    """How a dataset is divided.

    Attributes:
        shares: each part's share of the frames, adding up to 1.
        by: frames, or whole recordings.
        seed: of the drawing.
    """

    shares: Mapping[str, float]
    by: SplitBy = SplitBy.FRAMES
    seed: int = 0


def parse_shares(text: str) -> dict[str, float]:
    """Shares such as "train=0.8,val=0.2"; they may also be counts in proportion, such as "train=4,val=1".

    Raises:
        ConfigError: not of that form, a part comes twice, or a share is not positive.
    """
    shares: dict[str, float] = {}
    for part in text.split(","):
        name, sign, share = (word.strip() for word in part.partition("="))
        try:
            value = float(share)
        except ValueError:
            value = math.nan
        if not sign or not NAME.fullmatch(name) or not (0 < value < math.inf) or name in shares:
            raise ConfigError(f"{text!r} does not say how to divide: name each part once, as in train=0.8,val=0.2")
        shares[name] = value
    total = sum(shares.values())
    return {name: share / total for name, share in shares.items()}


def assign(split: Split, places: Sequence[tuple[str, str]]) -> list[str]:
    """The part of each frame. It does not depend on the order in which the frames come.

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
            f"{len(groups)} {split.by} cannot be divided into {len(split.shares)} parts "
            f"({', '.join(split.shares)}); name fewer parts, or divide by frames"
        )
    part_of = _drawn(split, dict(groups))
    return [part_of[(r,) if split.by is SplitBy.RECORDINGS else (r, k)] for r, k in places]


def _drawn(split: Split, groups: Mapping[tuple[str, ...], int]) -> dict[tuple[str, ...], str]:
    """In a drawn order, each group goes where most frames are still wanted; every part gets one at least."""
    names = sorted(groups)
    order = np.random.default_rng(split.seed).permutation(len(names))
    total = sum(groups.values())
    wanted = {part: share * total for part, share in split.shares.items()}
    empty, left = set(wanted), len(names)
    part_of: dict[tuple[str, ...], str] = {}
    for place in order:
        # in the order of the shares, not of a set, which differs from run to run: the first of equals is taken
        among = [name for name in wanted if name in empty or left > len(empty)]
        part = max(among, key=lambda name: wanted[name])
        part_of[names[place]] = part
        wanted[part] -= groups[names[place]]
        empty.discard(part)
        left -= 1
    return part_of
