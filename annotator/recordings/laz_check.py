"""Whether the compressed points of a LAZ file can be what its headers say.

The decompressor believes them: it makes room for as many chunks, and for layers as long, as they name, and ends the
program where there is no such room. So they are compared with the file's size before it sees them.

Format: laszip (`src/laszip.hpp`, `src/laszipdll`): a record of the items of a point, at the start of the data where
the table of chunks lies; layered chunks begin with a point, its chunk's number of points and the size of each layer.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

# version of the compressor, size of a chunk, number of items
RECORD = struct.Struct("<HHBBHIIqqH")
ITEM = struct.Struct("<HHH")
POINT_WISE, CHUNKED, LAYERED = 1, 2, 3
VARIABLE = 0xFFFFFFFF
# The items of each point format: laszip's type and the item's bytes.
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
# Layers of an item; bytes that no format names have one each.
LAYERS = {POINT14[0]: 9, RGB14[0]: 1, RGBNIR14[0]: 2, WAVE14[0]: 1}


@dataclass(frozen=True)
class LazLayout:
    """What the headers of a LAZ file say.

    Attributes:
        record: the content of laszip's own header.
        point_format: 0 to 10.
        point_bytes: of one point.
        points: how many there are.
        start: where the points' data begin in the file.
    """

    record: bytes
    point_format: int
    point_bytes: int
    points: int
    start: int


def laz_problem(data: bytes, layout: LazLayout) -> str:
    """What cannot be true of the bytes of a LAZ file, or "" where nothing is found."""
    items = _items(layout)
    if isinstance(items, str):
        return items
    compressor, _, _, _, _, _, chunk_points, _, _, _ = RECORD.unpack_from(layout.record)
    is_layered = layout.point_format >= FIRST_LAYERED_FORMAT
    if compressor not in ((LAYERED,) if is_layered else (POINT_WISE, CHUNKED)) or chunk_points == 0:
        return f"its points are compressed in a way ({compressor}) that their format {layout.point_format} has not"
    if compressor == POINT_WISE:
        return ""
    chunks = _table_size(data, layout)
    if chunks is None or chunks * layout.point_bytes > len(data):
        return f"its table of chunks is cut off or names too many ({chunks})"
    wanted = -(-layout.points // chunk_points)
    if chunk_points == VARIABLE:
        wanted = chunks
    elif wanted * layout.point_bytes > len(data):
        return f"promises {layout.points} points in {wanted} chunks, too many for its {len(data)} bytes"
    if not is_layered:
        return ""
    layers = sum(LAYERS.get(kind, size) for kind, size in items)
    return _chunk_problem(data, layout, wanted, layers)


def _items(layout: LazLayout) -> list[tuple[int, int]] | str:
    """Type and size of each item of a point, or what is wrong with them."""
    if len(layout.record) < RECORD.size:
        return "its compression is not described"
    count = RECORD.unpack_from(layout.record)[-1]
    if len(layout.record) < RECORD.size + count * ITEM.size:
        return "the description of its compression is cut off"
    found = [ITEM.unpack_from(layout.record, RECORD.size + number * ITEM.size) for number in range(count)]
    items = [(int(kind), int(size)) for kind, size, _ in found]
    versions = LAYERED_VERSIONS if layout.point_format >= FIRST_LAYERED_FORMAT else VERSIONS
    if not all(version in versions for _, _, version in found):
        return "its compression is of a version that nobody knows"
    expected = list(ITEMS.get(layout.point_format, ()))
    more = layout.point_bytes - sum(size for _, size in expected)
    if more > 0:
        expected.append((BYTES14 if layout.point_format >= FIRST_LAYERED_FORMAT else BYTES, more))
    return items if items == expected else f"its points' parts {items} are not those of its format {expected}"


def _table_size(data: bytes, layout: LazLayout) -> int | None:
    """How many chunks the table names, or None where there is no table."""
    for place in (layout.start, len(data) - 8):
        if 0 <= place <= len(data) - 8:
            (table,) = struct.unpack_from("<q", data, place)
            # a writer that could not go back has put it at the end
            if layout.start < table <= len(data) - 8:
                return int(struct.unpack_from("<I", data, table + 4)[0])
    return None


def _chunk_problem(data: bytes, layout: LazLayout, chunks: int, layers: int) -> str:
    """Walks over layered chunks by the sizes that they begin with."""
    sizes = struct.Struct(f"<{1 + layers}I")
    at = layout.start + 8
    for number in range(chunks):
        head = at + layout.point_bytes
        if head + sizes.size > len(data):
            return f"its chunk {number} of {chunks} is cut off"
        at = head + sizes.size + sum(sizes.unpack_from(data, head)[1:])
        if at > len(data):
            return f"its chunk {number} of {chunks} is longer than the file"
    return ""
