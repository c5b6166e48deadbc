"""PCD and PLY point clouds: headers that describe rows of text, or of binary numbers.

PCD: text, binary, and compressed binary. Format: Point Cloud Library, "The PCD file format" (0.7). The compression is
LZF: literal runs and back references. Format: liblzf's `lzf_d.c`.

PLY: text, and binary in either byte order. Format: G. Turk, "The PLY Polygon File Format" (1994).

open3d's readers lose 16-bit colours of text, round doubles in text to 32 bits, and fill what a cut file lacks; of
binary PCD, they take three times as long.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from annotator.frame_limits import require_memory
from annotator.recordings.clouds.columns import (
    RawCloud,
    binary_columns,
    field_columns,
    from_columns,
    text_columns,
)


def lzf_decompress(data: bytes, size: int) -> bytes:
    """Returns the decompressed bytes; a ValueError says that they are damaged, or not `size` bytes."""
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
            start, length = len(out) - distance, length + 2
            if start < 0:
                raise ValueError("a reference points before the beginning")
            piece = out[start : start + length]
            # source and destination may overlap
            out += piece if distance >= length else (piece * (length // distance + 1))[:length]
            if len(out) > size:
                break
    except IndexError:
        raise ValueError("a reference is truncated") from None
    if len(out) != size:
        raise ValueError(f"they decompress to at least {len(out)} bytes instead of {size}")
    return bytes(out)


KINDS = {"F": "f", "I": "i", "U": "u"}
PER_FIELD, LARGEST_POINT = ("SIZE", "TYPE", "COUNT"), 1 << 19
KEYWORDS = {"VERSION", "FIELDS", "COLUMNS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA"}


def parse_pcd(data: bytes) -> RawCloud:
    """Parses the points of a PCD file, in the frame that they are stored in (`VIEWPOINT` is not applied)."""
    header, offset = _pcd_header(data)
    try:
        dtype = _pcd_dtype(header)
        count = int(header["POINTS"][0]) if header.get("POINTS") else int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
        if count < 0:
            raise ValueError(f"{count} points")
    except (ValueError, TypeError, LookupError) as error:
        raise ValueError(f"the PCD header is damaged ({error})") from error
    encoding = " ".join(header["DATA"][:1])
    readers = {"ascii": text_columns, "binary": binary_columns, "binary_compressed": _compressed}
    if encoding not in readers:
        raise ValueError(f"the PCD encoding {encoding[:40]!r} is unknown; save it as {' or '.join(readers)}")
    return from_columns(readers[encoding](data, offset, count, dtype))


def _pcd_header(data: bytes) -> tuple[dict[str, list[str]], int]:
    """Returns the words of each header line, by keyword, and the offset of the header's end."""
    words: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in words:
        end = data.find(b"\n", at)
        if end < 0:
            raise ValueError("is not a PCD file, or its header is truncated")
        keyword, *rest = data[at:end].decode("latin-1").split() or ["#"]
        at = end + 1
        if keyword in KEYWORDS:
            words["FIELDS" if keyword == "COLUMNS" else keyword] = rest
        elif not keyword.startswith("#"):
            raise ValueError(f"is not a PCD file: its header has a line {keyword[:40]!r}")
    return words, at


def _pcd_dtype(header: dict[str, list[str]]) -> np.dtype:
    names = header["FIELDS"]
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    for position, name in enumerate(names):
        size, kind, count = (header[keyword][position] if keyword in header else "1" for keyword in PER_FIELD)
        # padding is called "_" and may occur several times
        unique = f"_{position}" if name == "_" else name.lower()
        fields.append((unique, f"<{KINDS[kind]}{int(size)}", () if int(count) == 1 else (int(count),)))
    dtype = np.dtype(fields)
    if dtype.itemsize > LARGEST_POINT:
        raise ValueError(f"points of {dtype.itemsize} bytes")
    return dtype


def _compressed(data: bytes, offset: int, count: int, dtype: np.dtype) -> dict[str, np.ndarray]:
    """Reads compressed points: two sizes, then LZF data with all values of the first field, of the second, ..."""
    if len(data) < offset + 8:
        raise ValueError("the PCD file ends before its points")
    packed, unpacked = (int(size) for size in np.frombuffer(data, "<u4", 2, offset))
    content = data[offset + 8 : offset + 8 + packed]
    if len(content) < packed:
        raise ValueError(f"declares {packed} compressed bytes but has {len(content)}")
    if unpacked < count * dtype.itemsize:
        raise ValueError(f"declares sizes that do not fit: {count} points, {unpacked} bytes, {packed} bytes compressed")
    require_memory(points=count, more_bytes=unpacked)
    try:
        plain = lzf_decompress(content, unpacked)
    except ValueError as error:
        raise ValueError(f"its compressed points are damaged ({error})") from error
    rows, at = np.empty(count, dtype), 0
    for name in dtype.names or ():
        rows[name] = np.frombuffer(plain, dtype[name], count, at)
        at += rows[name].nbytes
    return field_columns(rows)


ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
KINDS_BY_BYTES = {"char": "i1", "short": "i2", "int": "i4", "float": "f4", "double": "f8"}
TYPES = {
    **KINDS_BY_BYTES,
    **{f"u{name}": f"u{kind[1]}" for name, kind in KINDS_BY_BYTES.items() if kind[0] == "i"},
    **{np.dtype(kind).name: kind for kind in ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")},
}


@dataclass
class _Element:
    """One element of the header: the names and types of its properties, and whether some are lists."""

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)
    has_lists: bool = False

    def dtype(self, order: str) -> np.dtype:
        try:
            return np.dtype([(name, order + kind) for name, kind in self.properties])
        except ValueError as error:  # two properties with the same name
            raise ValueError(f"the PLY header's element {self.name}: {error}") from error


def parse_ply(data: bytes) -> RawCloud:
    """Parses the vertices of a PLY file; lists may only stand behind them, as faces do."""
    order, elements, offset = _ply_header(data)
    vertex = next((element for element in elements if element.name == "vertex"), None)
    if vertex is None:
        raise ValueError("the PLY file has no vertices")
    before = elements[: elements.index(vertex)]
    listed = [element.name for element in (*before, vertex) if element.has_lists]
    if listed:
        raise ValueError(
            f"its {listed[0]} elements have lists, which are only read behind the vertices; save it without"
        )
    dtype = vertex.dtype(ORDERS[order])
    if order == "ascii":
        return from_columns(text_columns(data, offset, vertex.count, dtype, sum(element.count for element in before)))
    offset += sum(element.count * element.dtype(ORDERS[order]).itemsize for element in before)
    return from_columns(binary_columns(data, offset, vertex.count, dtype))


def _ply_header(data: bytes) -> tuple[str, list[_Element], int]:
    """Returns the byte order, the elements, and the offset of the header's end."""
    end = data.find(b"end_header")
    newline = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or newline < 0:
        raise ValueError("is not a PLY file, or its header is truncated")
    order, elements = None, list[_Element]()
    # split at line feeds only: names in UTF-8 may hold bytes that `splitlines` treats as line ends
    for number, line in enumerate(data[:end].decode("latin-1").split("\n"), 1):
        match line.split():
            case ["format", name, _] if name in ORDERS:
                order = name
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 19:
                elements.append(_Element(name, int(count)))
            case ["property", "list", _, _, _] if elements:
                elements[-1].has_lists = True
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1].properties.append((name.lower(), TYPES[kind]))
            case [] | ["ply"] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"line {number} of the PLY header is invalid: {line[:60]!r}")
    if order is None:
        raise ValueError("the PLY header has no format line")
    return order, elements, newline + 1
