"""PCD point clouds: text, binary, and compressed binary. Format: Point Cloud Library, "The PCD file format" (0.7).

The compression is LZF: literal runs and back references. Format: liblzf's `lzf_d.c`.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from annotator.recordings.clouds.columns import (
    CLOUD_REMEDY,
    RawCloud,
    binary_columns,
    from_columns,
    require_points,
    split_colors,
    text_columns,
    typed,
)
from annotator.types.errors import FrameError

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


LONGEST_HEADER = 1 << 16
KINDS = {"F": "f", "I": "i", "U": "u"}
SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
KEYWORDS = {"VERSION", "FIELDS", "COLUMNS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA"}
MOST_VALUES_PER_FIELD, MOST_VALUES = 10_000, 1 << 16


def parse_pcd(path: Path, data: bytes) -> RawCloud:
    """Parses the points of a PCD file, in the frame that they are stored in (`VIEWPOINT` is not applied)."""
    header, offset = _header(path, data)
    dtype, count = _dtype(path, header), _count(path, header)
    encoding = header["DATA"][0] if header["DATA"] else ""
    if encoding == "ascii":
        return from_columns(path, _text(path, data, offset, count, dtype))
    if encoding == "binary":
        return from_columns(path, binary_columns(path, data, offset, count, dtype))
    if encoding == "binary_compressed":
        return from_columns(path, _compressed(path, data, offset, count, dtype))
    raise FrameError(
        path, f"the PCD encoding {encoding[:40]!r} is unknown", "save it as ascii, binary or binary_compressed"
    )


def _header(path: Path, data: bytes) -> tuple[dict[str, list[str]], int]:
    """Returns the words of each header line, by keyword, and the offset of the header's end."""
    words: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in words:
        end = data.find(b"\n", at, LONGEST_HEADER)
        if end < 0:
            raise FrameError(path, "is not a PCD file, or its header is truncated", CLOUD_REMEDY)
        keyword, *rest = data[at:end].decode("latin-1").split() or ["#"]
        at = end + 1
        if keyword in KEYWORDS:
            words["FIELDS" if keyword == "COLUMNS" else keyword] = rest
        elif not keyword.startswith("#"):
            raise FrameError(path, f"is not a PCD file: its header has a line {keyword[:40]!r}", CLOUD_REMEDY)
    missing = [keyword for keyword in ("FIELDS", "SIZE", "TYPE") if keyword not in words]
    if missing:
        raise FrameError(path, f"the PCD header has no {' and no '.join(missing)}", CLOUD_REMEDY)
    return words, at


def _dtype(path: Path, header: dict[str, list[str]]) -> np.dtype:
    names, sizes, types = header["FIELDS"], header["SIZE"], header["TYPE"]
    counts = header.get("COUNT", ["1"] * len(names))
    if not names or not len(names) == len(sizes) == len(types) == len(counts):
        raise FrameError(path, "FIELDS, SIZE, TYPE and COUNT of the PCD header have different lengths", CLOUD_REMEDY)
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    for position, (name, size, kind, count) in enumerate(zip(names, sizes, types, counts, strict=True)):
        values = _number(path, "COUNT", count)
        if kind not in KINDS or _number(path, "SIZE", size) not in SIZES[kind] or values > MOST_VALUES_PER_FIELD:
            raise FrameError(
                path, f"the PCD header's field {name[:40]} has the invalid type {kind}{size} x {count}", CLOUD_REMEDY
            )
        # padding is called "_" and may occur several times
        unique = f"_{position}" if name == "_" else name.lower()
        fields.append((unique, f"<{KINDS[kind]}{int(size)}", () if values == 1 else (values,)))
    if sum(math.prod(shape) for _, _, shape in fields) > MOST_VALUES:
        raise FrameError(path, f"the PCD header declares more than {MOST_VALUES} values per point", CLOUD_REMEDY)
    try:
        return np.dtype(fields)
    except ValueError as error:  # two fields with the same name
        raise FrameError(path, f"the PCD header's fields: {error}", CLOUD_REMEDY) from error


def _count(path: Path, header: dict[str, list[str]]) -> int:
    if header.get("POINTS"):
        return _number(path, "POINTS", header["POINTS"][0])
    if header.get("WIDTH") and header.get("HEIGHT"):
        return _number(path, "WIDTH", header["WIDTH"][0]) * _number(path, "HEIGHT", header["HEIGHT"][0])
    raise FrameError(path, "the PCD header has neither POINTS nor WIDTH and HEIGHT", CLOUD_REMEDY)


def _number(path: Path, keyword: str, text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) < 19):
        raise FrameError(path, f"{keyword} of the PCD header is not a number: {text[:40]!r}", CLOUD_REMEDY)
    return int(text)


def _text(path: Path, data: bytes, offset: int, count: int, dtype: np.dtype) -> dict[str, np.ndarray]:
    names = [name for name, _ in _flat(dtype)]
    table = text_columns(path, data[offset:], count, tuple(names), data[:offset].count(b"\n") + 1)
    return {name: typed(table[name], kind) for name, kind in _flat(dtype)}


def _flat(dtype: np.dtype) -> list[tuple[str, np.dtype]]:
    """Returns name and type of each value of a row."""
    flat: list[tuple[str, np.dtype]] = []
    for name in dtype.names or ():
        field = dtype[name]
        values = int(np.prod(field.shape))
        flat += [(name if values == 1 else f"{name}_{number}", field.base) for number in range(values)]
    return flat


def _compressed(path: Path, data: bytes, offset: int, count: int, dtype: np.dtype) -> dict[str, np.ndarray]:
    """Reads compressed points: two sizes, then LZF data with all values of the first field, of the second, ..."""
    if len(data) < offset + 8:
        raise FrameError(path, "the PCD file ends before its points", CLOUD_REMEDY)
    packed, unpacked = (int(size) for size in np.frombuffer(data, "<u4", 2, offset))
    content = data[offset + 8 : offset + 8 + packed]
    if len(content) < packed:
        raise FrameError(path, f"declares {packed} compressed bytes but has {len(content)}", CLOUD_REMEDY)
    # checked before memory is allocated: LZF expands data by at most MOST_EXPANSION
    if unpacked < count * dtype.itemsize or unpacked > max(packed * MOST_EXPANSION, 0):
        raise FrameError(
            path,
            f"declares sizes that do not fit: {count} points, {unpacked} bytes, {packed} bytes compressed",
            CLOUD_REMEDY,
        )
    require_points(path, count, more_bytes=unpacked)
    try:
        plain = lzf_decompress(content, unpacked)
    except ValueError as error:
        raise FrameError(path, f"its compressed points are damaged ({error})", CLOUD_REMEDY) from error
    columns, at = dict[str, np.ndarray](), 0
    for name in dtype.names or ():
        field = dtype[name]
        values = int(np.prod(field.shape))
        if values == 1:
            columns[name] = np.frombuffer(plain, field.base, count, at)
        else:
            columns |= split_colors(name, np.frombuffer(plain, field.base, count * values, at).reshape(count, values))
        at += count * field.itemsize
    return columns
