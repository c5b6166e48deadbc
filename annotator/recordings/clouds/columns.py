"""Converts the named columns of point cloud files to points, colours and reflectances.

Colours, of any type of number, become 8 bits: three columns, or a packed one. Alpha is left out.

    3 columns   8-bit integers as they are (signed ones by their bits); floats up to 1 are fractions; of all others,
                the lowest of the usual depths (8 to 16, 32 bits) that holds the highest value is the depth of all
    packed      0xAARRGGBB: a whole number of any type that is long enough, or the 32-bit float with these bits (PCL)

Text has no types: there, the values themselves say which of these they are. A colour that is not finite is black, and
a cloud without any finite colour has none.

Many files do not say whether their values are fractions, 8 or 16 bits, and a dark scan looks like one of a smaller
scale. The first scans of a recording decide for all: one scale of reflectance, and one of colours.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8

from annotator.frame_limits import require_memory
from annotator.recordings.plausible import are_returns
from annotator.types.errors import FrameError

NAMES = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
PACKED_NAMES = ("rgb", "rgba")
# Fields of several values are split.
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


def depth_bits(highest: float) -> int:
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


CLOUD_REMEDY = "save the cloud again, or remove the frame"
NO_RETURN = "every point is NaN or infinite, or (0, 0, 0), which means no return"
REFLECTANCE_NAMES = ("reflectance", "intensity", "scalar_intensity", "scalar_reflectance", "i")
# Maximum of reflectance values: fractions, 8 bits or 16 bits.
REFLECTANCE_SCALES = (1.0, 255.0, 65535.0)
# Share of the points that may be at the limit of one coordinate's type.
MOST_SATURATED = 0.01
NOT_A_NUMBER = re.compile(rb"[-+]?(?:1\.#\w+|nan\(\w*\))", re.IGNORECASE)
Scales = tuple[float, float]


@dataclass(frozen=True, eq=False)
class RawCloud:
    """The valid points of a file, in the file's own frame.

    Attributes:
        xyz_m: (n, 3), n > 0, finite.
        reflectance: 0..1, or None.
        scale: the reflectance that became 1, if only the values told; None = the file says it, or no reflectance.
        color_scale: the same for colours: the value that became 255.
    """

    xyz_m: Float64[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"] | None = None
    reflectance: Float32[np.ndarray, "n"] | None = None
    scale: float | None = None
    color_scale: float | None = None

    @property
    def scales(self) -> Scales:
        """Both scales; 0 = said by the file, or not there."""
        return self.scale or 0.0, self.color_scale or 0.0

    def select(self, keep: np.ndarray) -> RawCloud:
        return replace(
            self,
            xyz_m=self.xyz_m[keep],
            rgb=None if self.rgb is None else self.rgb[keep],
            reflectance=None if self.reflectance is None else self.reflectance[keep],
        )

    def with_scales(self, least: Scales) -> RawCloud:
        """Returns the cloud with at least these scales of reflectance and colours."""
        cloud = self
        if self.reflectance is not None and self.scale is not None and self.scale < least[0]:
            share = np.float32(self.scale / least[0])
            cloud = replace(cloud, reflectance=self.reflectance * share, scale=least[0])
        if self.rgb is not None and self.color_scale is not None and self.color_scale < least[1]:
            rgb = np.rint(self.rgb * (self.color_scale / least[1])).astype(np.uint8)
            cloud = replace(cloud, rgb=rgb, color_scale=least[1])
        return cloud


def from_columns(columns: Mapping[str, np.ndarray]) -> RawCloud:
    """Returns the returns among the points of columns of equal length (`are_returns`); column names are lower case."""
    missing = [name for name in "xyz" if name not in columns]
    if missing:
        present = ", ".join(columns) or "none"
        raise ValueError(f"has no column {' '.join(missing)} (its columns: {present})")
    require_memory(points=len(columns["x"]))
    xyz_m = np.stack([_real(columns[name]) for name in "xyz"], axis=1)
    valid = are_returns(xyz_m) & ~at_limits([columns[name] for name in "xyz"])
    if not valid.any():
        problem = NO_RETURN if len(valid) else "has no points"
        raise ValueError(problem)
    colors, (reflectance, scale) = point_colors(columns), _reflectance(columns)
    rgb, color_scale = (None, None) if colors is None else colors
    return RawCloud(xyz_m, rgb, reflectance, scale, color_scale).select(valid)


def at_limits(xyz: Sequence[np.ndarray]) -> Bool[np.ndarray, "n"]:
    """Returns which points are no measurements: a coordinate, as it is stored, is at a limit of its type.

    If they are all points, or many in which another coordinate is none, what was measured did not fit the type: a
    ValueError.
    """
    stored = np.stack([_at_limit(values) for values in xyz])
    # all three: what NaN became, or a driver's "no return"
    some, every = np.asarray(stored.any(axis=0)), np.asarray(stored.all(axis=0))
    if len(some) and (every.all() or (some & ~every).mean() > MOST_SATURATED):
        kinds = " ".join(sorted({values.dtype.name for values in xyz}))
        raise ValueError(
            f"its coordinates are saturated: {np.count_nonzero(some)} of {len(some)} points are at the limit of "
            f"{kinds}; an offset near the points, or larger steps help"
        )
    return some


def _at_limit(values: np.ndarray) -> Bool[np.ndarray, "n"]:
    """Bytes use their whole range, and the limits of longer floats are beyond `LARGEST`."""
    dtype = values.dtype
    if dtype == np.float16:
        return np.abs(values) == np.finfo(dtype).max
    if dtype.kind not in "iu" or dtype.itemsize == 1:
        return np.zeros(len(values), bool)
    limits = np.iinfo(dtype)
    return (values == limits.max) | ((values == limits.min) & (dtype.kind == "i"))


def fractions(values: Float[np.ndarray, "n"]) -> tuple[Float32[np.ndarray, "n"] | None, float | None]:
    """Returns reflectances as 0..1, and their scale: of the usual ones, the first that holds all of them.

    None if all are the highest number of 8 or 16 bits, which says nothing: they are a filling, or saturated.
    """
    highest = float(values.max(initial=0.0))
    if len(values) > 1 and highest in REFLECTANCE_SCALES[1:] and float(values.min()) == highest:
        return None, None
    scale = next((scale for scale in REFLECTANCE_SCALES if highest <= scale), highest)
    return np.clip(values.astype(np.float64) / scale, 0, 1).astype(np.float32), scale


def _real(values: np.ndarray) -> np.ndarray:
    """Returns the values as doubles; signalling NaNs in damaged files must not raise."""
    with np.errstate(all="ignore"):
        return values.astype(np.float64)


def _reflectance(columns: Mapping[str, np.ndarray]) -> tuple[Float32[np.ndarray, "n"] | None, float | None]:
    """Returns reflectances and their scale, if the values tell it."""
    name = next((name for name in REFLECTANCE_NAMES if name in columns), None)
    if name is None:
        return None, None
    values = np.nan_to_num(_real(columns[name]), nan=0.0, posinf=0.0, neginf=0.0)
    found, scale = fractions(values)
    if found is not None and columns[name].dtype == np.uint8:
        return np.asarray(values / REFLECTANCE_SCALES[1]).astype(np.float32), None
    return found, scale


def text_columns(data: bytes, offset: int, count: int, dtype: np.dtype, skipped: int = 0) -> dict[str, np.ndarray]:
    """Parses columns stored as text, one row per line, from a byte on; what follows the rows is ignored.

    Columns have the types of their header where their values fit these. Floats stay doubles: whole numbers beyond 24
    bits (packed colours) would lose digits. A field of several values is split into as many columns.
    """
    kinds = dict(_flat(dtype))
    # each value needs two bytes: impossible counts are rejected before memory is allocated
    if (count + skipped) * len(kinds) > len(data):
        raise ValueError(f"declares {count} points, too many for its {len(data)} bytes")
    require_memory(points=count, more_bytes=count * len(kinds) * 8)
    lines = list(islice(filter(bytes.strip, data[offset:].splitlines()), skipped, skipped + count))
    if len(lines) < count or not count:
        raise ValueError(f"declares {count} points but has {len(lines)}" if count else "has no points")
    # Windows writes -1.#IND or nan(ind), rounded also 1.#R; infinity (1.#INF) is no measurement either
    lines = [NOT_A_NUMBER.sub(b"nan", line) if b"#" in line or b"(" in line else line for line in lines]
    # numpy's errors say the row and the column
    table = np.loadtxt(lines, ndmin=2, usecols=range(len(kinds)), comments=None, encoding="ascii")
    return {name: _typed(table[:, column], kind) for column, (name, kind) in enumerate(kinds.items())}


def _flat(dtype: np.dtype) -> Iterator[tuple[str, np.dtype]]:
    for name in dtype.names or ():
        values = int(np.prod(dtype[name].shape))
        for number in range(values):
            yield name if values == 1 else f"{name}_{number}", dtype[name].base


def _typed(values: Float64[np.ndarray, "n"], dtype: np.dtype) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        whole = values if dtype.kind == "f" else values.astype(dtype)
    # writers put numbers into types that do not hold them, such as colours with alpha
    return whole if (whole == values).all() else values


def binary_columns(data: bytes, offset: int, count: int, dtype: np.dtype) -> dict[str, np.ndarray]:
    """Returns columns stored as packed rows of `dtype` at `offset`."""
    present = max(len(data) - offset, 0)
    if count * dtype.itemsize > present:
        raise ValueError(f"declares {count} points of {dtype.itemsize} bytes, but {present} bytes of points follow")
    return field_columns(np.frombuffer(data, dtype, count, offset))


def field_columns(rows: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the fields of a table that are numbers by their names in lower case; of several values, the first three.

    These are called `name_0`, `name_1`, `name_2`.
    """
    columns = {}
    for name in rows.dtype.names or ():
        values = rows[name]
        if values.dtype.kind in "fiu" and values.ndim == 1:
            columns[name.lower()] = values
        elif values.dtype.kind in "fiu" and values.ndim == 2:
            columns |= {f"{name.lower()}_{number}": column for number, column in enumerate(values.T[:3])}
    return columns


FIRST = 3

Source = TypeVar("Source")


class CommonScale:
    """The scales of the places from which scans come: folders, topics."""

    def __init__(self) -> None:
        self._found: dict[Hashable, Scales] = {}

    def apply(
        self, place: Hashable, raw: RawCloud, scans: Callable[[], Iterable[Source]], read: Callable[[Source], RawCloud]
    ) -> RawCloud:
        """Returns a scan with the scales of its place, or its own, if its values are larger.

        `scans` are those of the place, in a fixed order; a damaged one (ValueError, FrameError) is told by its frame.
        """
        if not any(raw.scales):
            return raw
        if place not in self._found:
            scales = list[Scales]()
            for scan in islice(scans(), FIRST):
                with suppress(FrameError, ValueError):
                    scales += filter(any, [read(scan).scales])
            if not scales:
                return raw
            self._found[place] = (max(each for each, _ in scales), max(each for _, each in scales))
        return raw.with_scales(self._found[place])


def files_like(path: Path) -> list[Path]:
    """Returns the files of a folder with the suffix of this one, by name."""
    return sorted(file for file in path.parent.iterdir() if file.suffix.lower() == path.suffix.lower())
