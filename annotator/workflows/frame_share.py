"""A share of some frames: the same one again for the same seed, whatever the order that they come in."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterable

from annotator.types.errors import ConfigError

FrameName = tuple[str, str]
"""Recording and key."""


def share_of(names: Iterable[FrameName], fraction: float, seed: int) -> frozenset[FrameName]:
    """A random share of frames, the same share of each recording (as far as whole frames can be).

    Each frame has its rank within its recording, by a hash of its name and the seed; the frames whose rank, as a part
    of the recording's length, is lowest are taken. So a smaller fraction's frames are among those of a larger one with
    the same seed, and a frame more or less changes little.

    Args:
        names: recording and key of each frame, in any order.
        fraction: above 0, at most 1; at least one frame is taken where there is any.
        seed: of the choice.

    Raises:
        ConfigError: a fraction out of its range.
    """
    if not 0 < fraction <= 1:
        raise ConfigError(f"a fraction of {fraction} of the frames cannot be taken; give more than 0, at most 1")
    recordings: dict[str, list[str]] = defaultdict(list)
    for recording, key in set(names):
        recordings[recording].append(key)
    ranked: list[tuple[float, str, FrameName]] = []
    for recording, keys in recordings.items():
        # by itself, the first of each of many short recordings would come before the second of any
        start = int(_hash(seed, recording)[:8], 16) / 2**32
        hashed = sorted((_hash(seed, recording, key), key) for key in keys)
        ranked += [((rank + start) / len(keys), h, (recording, key)) for rank, (h, key) in enumerate(hashed)]
    wanted = max(1, round(fraction * len(ranked)))
    return frozenset(name for *_, name in sorted(ranked)[:wanted])


def _hash(seed: int, *names: str) -> str:
    return hashlib.sha256("\0".join([str(seed), *names]).encode()).hexdigest()
