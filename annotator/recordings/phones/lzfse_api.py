"""LZFSE, Apple's compression, through the package `lzfse` (the extra `phones`)."""

from __future__ import annotations

from annotator.types.errors import MissingExtraError

# Data that cannot be compressed gets a little larger.
MOST_GROWTH, HEADS_BYTES = 1.1, 4096


def decompress(data: bytes, expected_bytes: int) -> bytes:
    """Returns the `expected_bytes` bytes in a compressed stream.

    Raises:
        MissingExtraError: the package is not installed.
        ValueError: damaged, or of another length; the message says which.
    """
    try:
        import lzfse
    except ImportError as error:
        raise MissingExtraError("lzfse", "phones") from error
    if len(data) > expected_bytes * MOST_GROWTH + HEADS_BYTES:
        raise ValueError(f"it has {len(data)} bytes, too many for an image of {expected_bytes}")
    try:
        raw = lzfse.decompress(data)
    except lzfse.error as error:
        raise ValueError("its compression (LZFSE) is damaged") from error
    if len(raw) != expected_bytes:
        raise ValueError(f"it has {len(raw)} bytes instead of {expected_bytes}")
    return bytes(raw)
