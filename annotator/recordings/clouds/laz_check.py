"""Checks the headers of a LAZ file's compressed points against the file's size.

The decompressor trusts the headers: it allocates memory for the chunks and layers that they declare, and aborts the
process if that fails. So the headers are checked first.

Format: laszip (`src/laszip.hpp`, `src/laszipdll`): a record of the items of a point; at the start of the data the
offset of the chunk table; a layered chunk begins with a point, its number of points and the size of each layer.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

# laszip's own header; used here: the compressor (first), points per chunk (seventh), number of items (last)
RECORD = struct.Struct("<HHBBHIIqqH")
ITEM = struct.Struct("<HHH")
POINT_WISE, CHUNKED, LAYERED = 1, 2, 3
VARIABLE = 0xFFFFFFFF
# The items of each point format: laszip's type and the item's size in bytes.
POINT10, GPS_TIME, RGB12, WAVE13 = (6, 20), (7, 8), (8, 6), (9, 29)
POINT14, RGB14, RGBNIR14, WAVE14 = (10, 30), (11, 6), (12, 8), (13, 29)
ITEMS: dict[int, tuple[tuple[int, int], ...]] = {
    0: (POINT10,),
    1: (POINT10, GPS_TIME),
    2: (POINT10, RGB12),
    3: (POINT10, GPS_TIME, RGB12),
    4: (POINT10, GPS_TIME, WAVE13),
    5: (POINT10, GPS_TIME, RGB12, WAVE13),
    6: (POINT14,),
    7: (POINT14, RGB14),
    8: (POINT14, RGBNIR14),
    9: (POINT14, WAVE14),
    10: (POINT14, RGBNIR14, WAVE14),
}
FIRST_LAYERED_FORMAT = 6
BYTES, BYTES14 = 0, 14
VERSIONS, LAYERED_VERSIONS = (1, 2), (3, 4)
# Layers of an item; extra bytes have one layer each.
LAYERS = {POINT14[0]: 9, RGB14[0]: 1, RGBNIR14[0]: 2, WAVE14[0]: 1}


@dataclass(frozen=True)
class LazLayout:
    """The contents of a LAZ file's headers.

    Attributes:
        record: the content of laszip's own header.
        point_format: 0 to 10.
        point_bytes: size of one point.
        points: number of points.
        start: offset of the points' data in the file.
    """

    record: bytes
    point_format: int
    point_bytes: int
    points: int
    start: int


def laz_problem(data: bytes, layout: LazLayout) -> str:
    """Returns the first problem in the headers of a LAZ file; "" if they are valid."""
    items = _items(layout)
    if isinstance(items, str):
        return items
    compressor, _, _, _, _, _, chunk_points, _, _, _ = RECORD.unpack_from(layout.record)
    is_layered = layout.point_format >= FIRST_LAYERED_FORMAT
    if compressor not in ((LAYERED,) if is_layered else (POINT_WISE, CHUNKED)) or chunk_points == 0:
        return f"its compressor ({compressor}) is not valid for point format {layout.point_format}"
    if compressor == POINT_WISE:
        return ""
    chunks = _table_size(data, layout)
    if chunks is None or chunks * layout.point_bytes > len(data):
        return f"its chunk table is truncated or lists too many chunks ({chunks})"
    needed = -(-layout.points // chunk_points)
    if chunk_points == VARIABLE:
        needed = chunks
    elif needed * layout.point_bytes > len(data):
        return f"declares {layout.points} points in {needed} chunks, too many for its {len(data)} bytes"
    if not is_layered:
        return ""
    layers = sum(LAYERS.get(kind, size) for kind, size in items)
    return _chunk_problem(data, layout, needed, layers)


def _items(layout: LazLayout) -> list[tuple[int, int]] | str:
    """Returns type and size of each item of a point, or what is wrong with them."""
    if len(layout.record) < RECORD.size:
        return "it has no laszip record"
    count = RECORD.unpack_from(layout.record)[-1]
    if len(layout.record) < RECORD.size + count * ITEM.size:
        return "its laszip record is truncated"
    entries = [ITEM.unpack_from(layout.record, RECORD.size + number * ITEM.size) for number in range(count)]
    items = [(int(kind), int(size)) for kind, size, _ in entries]
    versions = LAYERED_VERSIONS if layout.point_format >= FIRST_LAYERED_FORMAT else VERSIONS
    if not all(version in versions for _, _, version in entries):
        return "its compression has an unknown version"
    expected = list(ITEMS.get(layout.point_format, ()))
    more = layout.point_bytes - sum(size for _, size in expected)
    if more > 0:
        expected.append((BYTES14 if layout.point_format >= FIRST_LAYERED_FORMAT else BYTES, more))
    return (
        items if items == expected else f"its points have the items {items}, but their point format requires {expected}"
    )


def _table_size(data: bytes, layout: LazLayout) -> int | None:
    """Returns the number of chunks in the table; None without a table."""
    for place in (layout.start, len(data) - 8):
        if 0 <= place <= len(data) - 8:
            (table,) = struct.unpack_from("<q", data, place)
            # streaming writers put the offset at the end
            if layout.start < table <= len(data) - 8:
                return int(struct.unpack_from("<I", data, table + 4)[0])
    return None


def _chunk_problem(data: bytes, layout: LazLayout, chunks: int, layers: int) -> str:
    """Follows the layered chunks by the sizes at their beginning; returns the first problem, or ""."""
    sizes = struct.Struct(f"<{1 + layers}I")
    at = layout.start + 8
    for number in range(chunks):
        head = at + layout.point_bytes
        if head + sizes.size > len(data):
            return f"its chunk {number} of {chunks} is truncated"
        at = head + sizes.size + sum(sizes.unpack_from(data, head)[1:])
        if at > len(data):
            return f"its chunk {number} of {chunks} is longer than the file"
    return ""
