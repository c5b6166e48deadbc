"""PLY point clouds: text, and binary in either byte order. Format: G. Turk, "The PLY Polygon File Format" (1994)."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np

from annotator.recordings.clouds.columns import CLOUD_REMEDY, RawCloud, binary_columns, from_columns, text_columns
from annotator.types.errors import FrameError

LONGEST_HEADER = 1 << 16
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}


@dataclass
class _Element:
    """One element of the header; `properties` holds names and types, "" as the type of a list."""

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)


def parse_ply(path: Path, data: bytes) -> RawCloud:
    """Parses the vertices of a PLY file.

    Raises:
        FrameError: a damaged header, fewer points than declared, or no valid point.
    """
    order, elements, offset = _header(path, data)
    vertex = next((element for element in elements if element.name == "vertex"), None)
    if vertex is None:
        raise FrameError(path, "the PLY file has no vertices", CLOUD_REMEDY)
    before = elements[: elements.index(vertex)]
    if any(kind == "" for element in (*before, vertex) for _, kind in element.properties):
        raise FrameError(path, "the PLY file has lists in or before its vertices", "save it with the vertices first")
    if not vertex.properties:
        raise FrameError(path, "the PLY file's vertices have no properties", CLOUD_REMEDY)
    if order == "ascii":
        return _from_text(path, data, offset, before, vertex)
    start = offset + sum(element.count * _dtype(path, element, order).itemsize for element in before)
    return from_columns(path, binary_columns(path, data, start, vertex.count, _dtype(path, vertex, order)))


def _from_text(path: Path, data: bytes, offset: int, before: list[_Element], vertex: _Element) -> RawCloud:
    body, skipped = data[offset:], sum(element.count for element in before)
    lines_above = data[:offset].count(b"\n")
    if skipped:
        if skipped > body.count(b"\n"):
            raise FrameError(path, "the PLY file ends before its vertices", CLOUD_REMEDY)
        last = next(islice(re.finditer(b"\n", body), skipped - 1, None))
        body = body[last.end() :]
    names = tuple(name for name, _ in vertex.properties)
    columns = text_columns(path, body, vertex.count, names, lines_above + skipped + 1)
    # text has no types: without this, byte colours up to 1 would be read as fractions
    typed = {name: _as_bytes(columns[name]) if kind == "u1" else columns[name] for name, kind in vertex.properties}
    return from_columns(path, typed)


def _as_bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.nan_to_num(values), 0, 255).astype(np.uint8)


def _header(path: Path, data: bytes) -> tuple[str, list[_Element], int]:
    """Returns the byte order, the elements, and the offset of the header's end."""
    end = data.find(b"end_header", 0, LONGEST_HEADER)
    newline = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or newline < 0:
        raise FrameError(path, "is not a PLY file, or its header is truncated", CLOUD_REMEDY)
    order, elements = None, list[_Element]()
    # split at line feeds only: names in UTF-8 may hold bytes that `splitlines` treats as line ends
    for number, line in enumerate(data[:end].decode("latin-1").split("\n"), 1):
        match line.split():
            case ["format", name, _] if name in ORDERS:
                order = name
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 19:
                elements.append(_Element(name, int(count)))
            case ["property", "list", _, _, name] if elements:
                elements[-1].properties.append((name.lower(), ""))
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1].properties.append((name.lower(), TYPES[kind]))
            case [] | ["ply"] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise FrameError(path, f"line {number} of the PLY header is invalid: {line[:60]!r}", CLOUD_REMEDY)
    if order is None:
        raise FrameError(path, "the PLY header has no format line", CLOUD_REMEDY)
    return order, elements, newline + 1


def _dtype(path: Path, element: _Element, order: str) -> np.dtype:
    try:
        return np.dtype([(name, ORDERS[order] + kind) for name, kind in element.properties])
    except ValueError as error:  # two properties with the same name
        raise FrameError(path, f"the PLY header's element {element.name}: {error}", CLOUD_REMEDY) from error
