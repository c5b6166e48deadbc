"""PLY point clouds: text, and binary in either byte order. Format: G. Turk, "The PLY Polygon File Format" (1994)."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np

from annotator.recordings.clouds.columns import (
    CLOUD_REMEDY,
    RawCloud,
    binary_columns,
    from_columns,
    text_columns,
    typed,
)
from annotator.types.errors import FrameError

LONGEST_HEADER = 1 << 16
# Begins the name of the field with a list's length.
LENGTH = "length of "
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
    """One element of the header.

    Attributes:
        properties: names and types; of a list, the type of its values.
        lengths: types of the lists' lengths, by name.
    """

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)
    lengths: dict[str, str] = field(default_factory=dict)

    def pick(self, values: list[bytes]) -> list[bytes]:
        """Returns the values of a line without its lists; fewer if the line is too short."""
        picked, at = [], 0
        for name, _ in self.properties:
            if at >= len(values):
                break
            if name not in self.lengths:
                picked.append(values[at])
                at += 1
            elif values[at].isdigit():
                at += 1 + int(values[at])
            else:
                break
        return picked


def parse_ply(path: Path, data: bytes) -> RawCloud:
    """Parses the vertices of a PLY file, without lists."""
    order, elements, offset = _header(path, data)
    vertex = next((element for element in elements if element.name == "vertex"), None)
    if vertex is None:
        raise FrameError(path, "the PLY file has no vertices", CLOUD_REMEDY)
    before = elements[: elements.index(vertex)]
    if not vertex.properties:
        raise FrameError(path, "the PLY file's vertices have no properties", CLOUD_REMEDY)
    if order == "ascii":
        return _from_text(path, data, offset, before, vertex)
    for element in before:
        offset += element.count * _dtype(path, data, offset, element, ORDERS[order]).itemsize
    dtype = _dtype(path, data, offset, vertex, ORDERS[order])
    return from_columns(path, binary_columns(path, data, offset, vertex.count, dtype))


def _from_text(path: Path, data: bytes, offset: int, before: list[_Element], vertex: _Element) -> RawCloud:
    body, skipped = data[offset:], sum(element.count for element in before)
    lines_above = data[:offset].count(b"\n")
    if skipped:
        if skipped > body.count(b"\n"):
            raise FrameError(path, "the PLY file ends before its vertices", CLOUD_REMEDY)
        last = next(islice(re.finditer(b"\n", body), skipped - 1, None))
        body = body[last.end() :]
    kinds = [(name, kind) for name, kind in vertex.properties if name not in vertex.lengths]
    if not kinds:
        raise FrameError(path, "the PLY file's vertices have only lists", CLOUD_REMEDY)
    names = tuple(name for name, _ in kinds)
    pick = vertex.pick if vertex.lengths else None
    columns = text_columns(path, body, vertex.count, names, lines_above + skipped + 1, pick)
    return from_columns(path, {name: typed(columns[name], np.dtype(kind)) for name, kind in kinds})


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
            case ["property", "list", length, kind, name] if elements and {length, kind} <= TYPES.keys():
                elements[-1].properties.append((name.lower(), TYPES[kind]))
                elements[-1].lengths[name.lower()] = TYPES[length]
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1].properties.append((name.lower(), TYPES[kind]))
            case [] | ["ply"] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise FrameError(path, f"line {number} of the PLY header is invalid: {line[:60]!r}", CLOUD_REMEDY)
    if order is None:
        raise FrameError(path, "the PLY header has no format line", CLOUD_REMEDY)
    return order, elements, newline + 1


def _dtype(path: Path, data: bytes, offset: int, element: _Element, order: str) -> np.dtype:
    """Returns the type of an element's rows, which begin at `offset`."""
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    at = offset
    for name, kind in element.properties:
        if name in element.lengths:
            length = np.dtype(order + element.lengths[name])
            # the first row stands for all; with fewer bytes than rows, its reader complains
            there = data[at : at + length.itemsize]
            count = int(np.frombuffer(there, length)[0]) if element.count and len(there) == length.itemsize else 0
            if not 0 <= count <= len(data):
                raise FrameError(path, f"the list {name} of the PLY element {element.name} is damaged", CLOUD_REMEDY)
            fields += [(LENGTH + name, length.str), (name, order + kind, (count,))]
            at += length.itemsize + count * np.dtype(kind).itemsize
        else:
            fields.append((name, order + kind))
            at += np.dtype(kind).itemsize
    try:
        dtype = np.dtype(fields)
    except ValueError as error:  # two properties with the same name
        raise FrameError(path, f"the PLY header's element {element.name}: {error}", CLOUD_REMEDY) from error
    if element.lengths:
        # what is missing is told with the vertices
        count = min(element.count, max(len(data) - offset, 0) // dtype.itemsize)
        rows = np.frombuffer(data, dtype, count, offset)
        varying = [name for name in element.lengths if np.ptp(rows[LENGTH + name]) > 0] if count else []
        if varying:
            raise FrameError(
                path,
                f"its {element.name} elements have lists of different lengths ({', '.join(varying)}), which are only "
                "read behind the vertices, or from text",
                "save it without them, or as text",
            )
    return dtype
