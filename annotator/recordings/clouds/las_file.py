"""LAS and LAZ point clouds, through laspy and lazrs (the extra `las`).

Format: ASPRS, "LAS Specification 1.4", R15. Coordinates are integers with a scale and an offset, usually map
coordinates in metres (`cloud_folder` moves the origin). Intensity and colours have 16 bits; some writers use fewer.

The decompressor of LAZ (lazrs) trusts what it reads, so it runs in the `fence`.
"""

from __future__ import annotations

import io
import struct
from importlib.util import find_spec

import numpy as np

from annotator.fence import fenced
from annotator.frame_limits import require_memory
from annotator.recordings.clouds.columns import RawCloud, at_limits, from_columns
from annotator.types.errors import MissingExtraError

SIGNATURE = b"LASF"
# From byte 94: header size, offset of the points, number of records before them, point format, bytes per point, points.
HEAD_AT, HEAD = 94, struct.Struct("<HIIBHI")
SHORTEST_LAS_HEADER = 227
COMPRESSED_BITS = 0xC0
RECORD_HEAD_BYTES = 54
COLORS = ("red", "green", "blue")


def parse_las(data: bytes) -> RawCloud:
    """Parses the points of a LAS or LAZ file, without withheld ones; its unit is assumed to be metres."""
    # laspy imports lazrs by itself, without an error if it is missing
    if find_spec("laspy") is None or find_spec("lazrs") is None:
        raise MissingExtraError("laspy[lazrs]", "las")
    columns = fenced(f"{__name__}:decode", data) if _is_compressed(data) else decode(data)
    kept = ~at_limits([columns.pop(name) for name in "XYZ"]) & (columns.pop("withheld") == 0)
    # zeros throughout: not measured
    has_colors = any(columns[name].any() for name in COLORS if name in columns)
    unused = set() if has_colors else {*COLORS}
    unused |= set() if columns["intensity"].any() else {"intensity"}
    return from_columns({name: values[kept] for name, values in columns.items() if name not in unused})


def _is_compressed(data: bytes) -> bool:
    """Rejects impossible record counts, which would keep laspy busy for hours."""
    if not data.startswith(SIGNATURE) or len(data) < SHORTEST_LAS_HEADER:
        raise ValueError("is not a LAS file, or its header is truncated")
    header_bytes, start, records, point_format, point_bytes, _ = HEAD.unpack_from(data, HEAD_AT)
    if not SHORTEST_LAS_HEADER <= header_bytes <= start <= len(data) or point_bytes == 0:
        raise ValueError(f"the LAS header declares an impossible position of the points, byte {start}")
    if records * RECORD_HEAD_BYTES > start - header_bytes:
        raise ValueError(f"declares {records} records before its points, but fewer fit there")
    return bool(point_format & COMPRESSED_BITS)


def decode(data: bytes) -> dict[str, np.ndarray]:
    """Returns the columns of a file whose header was checked, in this process: coordinates also as they are stored.

    Raises:
        ValueError: it is damaged.
    """
    import laspy

    # layers that are not needed stay compressed
    layers = laspy.DecompressionSelection
    selection = layers.XY_RETURNS_CHANNEL | layers.Z | layers.INTENSITY | layers.RGB | layers.FLAGS
    try:
        with laspy.LasReader(
            io.BytesIO(data), laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False, decompression_selection=selection
        ) as reader:
            header = reader.header
            count = header.point_count
            require_memory(points=count)
            points = reader.read_points(count)
    except MemoryError:
        raise
    except Exception as error:  # of a damaged file, laspy raises any
        raise ValueError(f"cannot be read as LAS or LAZ ({str(error)[:300]})") from error
    if len(points) != count:
        raise ValueError(f"declares {count} points but ends after {len(points)}")
    names = {"X", "Y", "Z", "x", "y", "z", "intensity", "withheld", *COLORS}
    # scale and offset of a damaged file may be any bits
    with np.errstate(all="ignore"):
        present = [name for name in sorted(names) if name in "xyz" or name in header.point_format.dimension_names]
        return {name: np.array(points[name]) for name in present}
