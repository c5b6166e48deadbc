"""Colours of points, of any type of number, as 8 bits: three columns, or a packed one. Alpha is left out.

    3 columns   8-bit integers as they are (signed ones by their bits); floats up to 1 are fractions; of all others, the
                lowest of the usual depths (8 to 16, 32 bits) that holds the highest value is the depth of all
    packed      0xAARRGGBB: a whole number of any type that is long enough, or the 32-bit float with these bits (PCL)

Text has no types: there, the values themselves say which of these they are. A colour that is not finite is black, and a
cloud without any finite colour has none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, UInt8

NAMES = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
PACKED_NAMES = ("rgb", "rgba")
# Columns of several values are split (`split_colors`).
SPLIT_NAMES = tuple(tuple(f"{name}_{channel}" for channel in range(3)) for name in (*PACKED_NAMES, "color", "colors"))
# Depths of cameras and scanners, bits; numbers of 16 bits may use fewer.
DEPTHS = (8, 10, 12, 14, 16, 32)
# Fractions may exceed 1 by rounding; or this share does not.
MOST_FRACTION, FRACTIONS = 1.005, 0.99
# The bits of NaN as programs write it; other bits of NaNs are colours with alpha.
NAN_BITS = 0x7FC00000

Colors = tuple[UInt8[np.ndarray, "n 3"], float | None]
"""Colours, and the value that became 255; None if the type says it."""


def point_colors(columns: Mapping[str, np.ndarray]) -> Colors | None:
    """Returns the colours of columns with lower-case names; None without any."""
    for names in (*NAMES, *SPLIT_NAMES):
        if all(name in columns for name in names):
            return eight_bits([columns[name] for name in names])
    for name in PACKED_NAMES:
        if name in columns:
            rgb = _unpacked(columns[name])
            return None if rgb is None else (rgb, None)
    return None


def split_colors(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Returns columns for the values (n, k) of a field; none unless its name is that of colours."""
    channels = {f"{name}_{channel}": values[:, channel] for channel in range(min(3, values.shape[1]))}
    return channels if tuple(channels) in SPLIT_NAMES else {}


def depth_bits(highest: float) -> int:
    """Returns the lowest of `DEPTHS` that holds a value."""
    return next((bits for bits in DEPTHS if highest < 2**bits), DEPTHS[-1])


def eight_bits(channels: Sequence[np.ndarray]) -> Colors | None:
    """Returns colours of three columns of any type; None if no value is finite."""
    values = _native(np.stack(channels, axis=1))
    if values.dtype in (np.uint8, np.int8):
        return values.view(np.uint8), None
    if values.dtype == np.int16 and (values < 0).any():
        values = values.view(np.uint16)
    levels = _finite(values)
    if levels is None:
        return None
    highest = float(levels.max(initial=0.0))
    if values.dtype.kind == "f" and (highest <= MOST_FRACTION or _are_fractions(levels)):
        return np.rint(np.clip(levels, 0, 1) * 255).astype(np.uint8), 1.0
    bits = depth_bits(highest)
    # of more bits, the upper eight: exact both for c * 257 and for c * 256
    levels = np.rint(levels) if bits == 8 else np.floor(levels / 2 ** (bits - 8))
    return np.clip(levels, 0, 255).astype(np.uint8), 2.0**bits - 1


def _are_fractions(levels: np.ndarray) -> bool:
    """True if only highlights exceed 1; numbers of 8 bits and more are whole as a rule, and most are larger."""
    return bool(np.quantile(levels, FRACTIONS) <= 1 and (np.rint(levels) != levels).any())


def _finite(values: np.ndarray) -> Float[np.ndarray, "..."] | None:
    """Returns the values as doubles, 0 where they are not finite; None if none is."""
    with np.errstate(all="ignore"):
        levels = values.astype(np.float64)
    known = np.isfinite(levels)
    return np.where(known, levels, 0.0) if known.any() or not levels.size else None


def _native(values: np.ndarray) -> np.ndarray:
    """Returns values in the machine's byte order, NaNs with the same bits."""
    return values.astype(values.dtype.newbyteorder("="), copy=False)


def _unpacked(packed: np.ndarray) -> UInt8[np.ndarray, "n 3"] | None:
    packed = _native(packed)
    if packed.dtype.itemsize < 4:
        return None
    if packed.dtype.kind in "iu":
        bits = packed.astype(np.int64 if packed.dtype.kind == "i" else np.uint64).view(np.uint64)
    else:
        numbers = _finite(packed)
        if numbers is not None and numbers.any() and _are_whole(numbers):
            bits = numbers.astype(np.int64).view(np.uint64)
        elif numbers is None and packed.dtype != np.float32:
            return None
        else:
            with np.errstate(all="ignore"):
                bits = np.ascontiguousarray(packed, np.float32).view(np.uint32).astype(np.uint64)
            bits[bits == NAN_BITS] = 0
            if numbers is None and not bits.any():
                return None
    return np.stack([bits >> np.uint64(shift) & np.uint64(255) for shift in (16, 8, 0)], axis=1).astype(np.uint8)


def _are_whole(numbers: np.ndarray) -> bool:
    """True for integers of 32 bits; as numbers, floats with the bits of colours are tiny or huge."""
    return bool((np.rint(numbers) == numbers).all() and numbers.min() >= -(2**31) and numbers.max() < 2**32)
