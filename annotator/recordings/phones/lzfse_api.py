"""LZFSE, Apple's compression, through the package `lzfse` (the extra `phones`).

The package decompresses to any length. So the blocks of a stream are listed first, with the lengths that they declare.
Format: github.com/lzfse/lzfse, lzfse_internal.h. A block begins with its kind and its length after decompression.
"""

from __future__ import annotations

import struct

from annotator.frame_limits import require_memory
from annotator.types.errors import MissingExtraError

# Data that cannot be compressed gets a little larger.
MOST_GROWTH, HEADS_BYTES = 1.1, 4096
# Kinds of blocks: as it is, LZVN, LZFSE, and the end of the stream.
PLAIN, LZVN, LZFSE, END = b"bvx-", b"bvxn", b"bvx2", b"bvx$"
SHORTEST_HEADER = 32
# The longest literal run and match.
LONGEST_STEP = 315 + 2359


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
    declared, most = _declared_bytes(data)
    if declared != expected_bytes:
        raise ValueError(f"it has {declared} bytes instead of {expected_bytes}")
    require_memory(more_bytes=most)
    try:
        raw = lzfse.decompress(data)
    except lzfse.error as error:
        raise ValueError("its compression (LZFSE) is damaged") from error
    if len(raw) != expected_bytes:
        raise ValueError(f"it has {len(raw)} bytes instead of {expected_bytes}")
    return bytes(raw)


def _declared_bytes(data: bytes) -> tuple[int, int]:
    """Returns the length that a stream declares, and the most that a damaged one may decompress to.

    Raises:
        ValueError: it is damaged.
    """
    declared = most = at = 0
    while True:
        kind = data[at : at + 4]
        if kind == END:
            return declared, most
        try:
            (length,) = struct.unpack_from("<I", data, at + 4)
            if kind == PLAIN:
                at, longest = at + 8 + length, length
            elif kind == LZVN:
                at, longest = at + 12 + struct.unpack_from("<I", data, at + 8)[0], length
            elif kind == LZFSE:
                # bits of three words: literals, their bytes, matches; bytes of matches; bytes of this header
                first, second, third = struct.unpack_from("<QQQ", data, at + 8)
                # the decoder counts the matches, not the bytes that they give
                longest = (first >> 40 & 0xFFFFF) * LONGEST_STEP
                if third & 0xFFFFFFFF < SHORTEST_HEADER:
                    raise ValueError("its compression (LZFSE) is damaged")
                at += (third & 0xFFFFFFFF) + (first >> 20 & 0xFFFFF) + (second >> 40 & 0xFFFFF)
            else:
                raise ValueError("its compression (LZFSE) is damaged")
        except struct.error as error:
            raise ValueError("its compression (LZFSE) is damaged or truncated") from error
        declared, most = declared + length, most + max(longest, length)
