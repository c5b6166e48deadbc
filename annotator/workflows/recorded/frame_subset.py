"""A reproducible random share of frames, independent of their order."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterable

from annotator.types.errors import ConfigError

FrameName = tuple[str, str]
"""Recording and key."""


def share_of(names: Iterable[FrameName], fraction: float, seed: int) -> frozenset[FrameName]:
    """Chooses a random share of frames, the same share of each recording as far as whole frames allow.

    Frames are ranked within their recording by a hash of their name and the seed. Those with the lowest rank relative
    to the recording's length are chosen. So the frames of a smaller fraction are among those of a larger one with the
    same seed, and adding or removing a frame changes the choice little.

    Args:
        names: recording and key of each frame, in any order.
        fraction: above 0, at most 1; at least one frame is chosen if there is any.
        seed: of the choice.

    Raises:
        ConfigError: `fraction` is out of range.
    """
    if not 0 < fraction <= 1:
        raise ConfigError(f"cannot take a fraction of {fraction} of the frames; give more than 0, at most 1")
    recordings: dict[str, list[str]] = defaultdict(list)
    for recording, key in set(names):
        recordings[recording].append(key)
    ranked: list[tuple[float, str, FrameName]] = []
    for recording, keys in recordings.items():
        # a random offset per recording: else the first frames of all short recordings would come before all others
        start = int(_hash(seed, recording)[:8], 16) / 2**32
        hashed = sorted((_hash(seed, recording, key), key) for key in keys)
        ranked += [((rank + start) / len(keys), h, (recording, key)) for rank, (h, key) in enumerate(hashed)]
    count = max(1, round(fraction * len(ranked)))
    return frozenset(name for *_, name in sorted(ranked)[:count])


def _hash(seed: int, *names: str) -> str:
    return hashlib.sha256("\0".join([str(seed), *names]).encode()).hexdigest()
