"""The fixed fifth of the frames that never trains a detector and decides between detectors."""

from __future__ import annotations

import hashlib

SHARE = 0.2


def is_held_out(group: str, share: float = SHARE) -> bool:
    """Whether a frame is held out, by a hash of its samples' group: always the same, whatever else is labelled."""
    number = int.from_bytes(hashlib.sha256(group.encode()).digest()[:8], "big")
    return number < share * 2**64
