"""LZF, the compression of PCD files: literal runs and back references, a byte at a time. Format: liblzf's `lzf_d.c`."""

from __future__ import annotations

# The longest reference, 264 bytes, takes three.
MOST_EXPANSION = 88


def lzf_decompress(data: bytes, size: int) -> bytes:
    """The `size` bytes that were compressed.

    Raises:
        ValueError: the data are damaged, or give another number of bytes.
    """
    out = bytearray()
    at, end = 0, len(data)
    try:
        while at < end:
            control = data[at]
            at += 1
            if control < 32:
                if at + control >= end:
                    raise ValueError("a run goes on beyond the end")
                out += data[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[at]
                at += 1
            distance = ((control & 31) << 8 | data[at]) + 1
            at += 1
            _repeat(out, distance, length + 2)
            if len(out) > size:
                break
    except IndexError:
        raise ValueError("a reference is cut off") from None
    if len(out) != size:
        raise ValueError(f"they give {len(out)} bytes or more instead of {size}")
    return bytes(out)


def _repeat(out: bytearray, distance: int, length: int) -> None:
    """Appends `length` bytes that begin `distance` before the end, and may reach into what is appended."""
    start = len(out) - distance
    if start < 0:
        raise ValueError("a reference goes back before the beginning")
    if distance >= length:
        out += out[start : start + length]
    else:
        pattern = bytes(out[start:])
        out += (pattern * (length // distance + 1))[:length]
