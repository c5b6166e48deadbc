"""LZF, the compression of PCD files: literal runs and back references. Format: liblzf's `lzf_d.c`."""

from __future__ import annotations

# The longest reference, 264 bytes, is encoded in three bytes.
MOST_EXPANSION = 88


def lzf_decompress(data: bytes, size: int) -> bytes:
    """Returns the `size` decompressed bytes.

    Raises:
        ValueError: the data are damaged, or the decompressed size is not `size`.
    """
    out = bytearray()
    at, end = 0, len(data)
    try:
        while at < end:
            control = data[at]
            at += 1
            if control < 32:
                if at + control >= end:
                    raise ValueError("a literal run is truncated")
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
        raise ValueError("a reference is truncated") from None
    if len(out) != size:
        raise ValueError(f"they decompress to at least {len(out)} bytes instead of {size}")
    return bytes(out)


def _repeat(out: bytearray, distance: int, length: int) -> None:
    """Appends `length` bytes from `distance` before the end; source and destination may overlap."""
    start = len(out) - distance
    if start < 0:
        raise ValueError("a reference points before the beginning")
    if distance >= length:
        out += out[start : start + length]
    else:
        pattern = bytes(out[start:])
        out += (pattern * (length // distance + 1))[:length]
