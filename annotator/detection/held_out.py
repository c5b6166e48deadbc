"""The fixed fifth of the frames that never trains a detector and decides between detectors."""

from __future__ import annotations

import hashlib

SHARE = 0.2


def is_held_out(key: str, share: float = SHARE) -> bool:
    """Whether a frame is held out, by a hash of its key: the same in every round, whatever else is labelled."""
    number = int.from_bytes(hashlib.sha256(key.encode()).digest()[:8], "big")
    return number < share * 2**64
