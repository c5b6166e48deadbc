"""LAS and LAZ point clouds, through laspy and lazrs (the extra `las`).

Format: ASPRS, "LAS Specification 1.4", R15. Coordinates are integers with a scale and an offset, usually map
coordinates in metres (`cloud_folder` moves the origin). Intensity and colours have 16 bits; some writers use fewer.
"""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from annotator.recordings.clouds.columns import CLOUD_REMEDY, RawCloud, at_limits, from_columns, require_points
from annotator.recordings.clouds.laz_check import LazLayout, laz_problem
from annotator.recordings.clouds.laz_process import decode_laz
from annotator.types.errors import FrameError, MissingExtraError

if TYPE_CHECKING:
    import laspy

SIGNATURE = b"LASF"
# From byte 94: header size, offset of the points, number of records before them, point format, bytes per point, points.
HEAD_AT, HEAD = 94, struct.Struct("<HIIBHI")
SHORTEST_HEADER = 227
POINT_FORMAT_AT, COMPRESSED_BITS = 104, 0xC0
RECORD_HEAD_BYTES = 54
POINTS_AT_ONCE = 1 << 16


def parse_las(path: Path, data: bytes) -> RawCloud:
    """Parses the points of a LAS or LAZ file, without withheld ones; its unit is assumed to be metres.

    Raises:
        MissingExtraError: laspy or lazrs is not installed.
        FrameError: a damaged header, fewer points than declared, damaged compression, or no valid point.
    """
    try:
        import laspy  # noqa: F401
        import lazrs  # noqa: F401 - laspy imports it by itself, without an error if it is missing
    except ImportError as error:
        raise MissingExtraError("laspy[lazrs]", "las") from error
    _check_header(path, data)
    is_compressed = bool(data[POINT_FORMAT_AT] & COMPRESSED_BITS)
    return from_columns(path, decode_laz(path, data) if is_compressed else decode(path, data))


def decode(path: Path, data: bytes) -> dict[str, np.ndarray]:
    """Returns the columns of a file whose header was checked, in this process.

    Raises:
        FrameError: as `parse_las`.
    """
    import laspy

    # layers that are not needed stay compressed
    layers = laspy.DecompressionSelection
    selection = layers.XY_RETURNS_CHANNEL | layers.Z | layers.INTENSITY | layers.RGB | layers.FLAGS
    try:
        with laspy.LasReader(
            io.BytesIO(data), laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False, decompression_selection=selection
        ) as reader:
            _check_points(path, data, reader.header)
            return _columns(path, reader)
    except FrameError:
        raise
    # for damaged files laspy raises any exception, and lazrs a PanicException, which is not an Exception
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise FrameError(path, f"cannot be read as LAS or LAZ ({str(error)[:100]})", CLOUD_REMEDY) from error


def _check_header(path: Path, data: bytes) -> None:
    """Rejects impossible record counts, which would keep laspy busy for hours."""
    if not data.startswith(SIGNATURE) or len(data) < SHORTEST_HEADER:
        raise FrameError(path, "is not a LAS file, or its header is truncated", CLOUD_REMEDY)
    header_bytes, start, records, _, point_bytes, _ = HEAD.unpack_from(data, HEAD_AT)
    if not SHORTEST_HEADER <= header_bytes <= start <= len(data) or point_bytes == 0:
        raise FrameError(
            path, f"the LAS header declares an impossible position of the points, byte {start}", CLOUD_REMEDY
        )
    if records * RECORD_HEAD_BYTES > start - header_bytes:
        raise FrameError(path, f"declares {records} records before its points, but fewer fit there", CLOUD_REMEDY)


def _check_points(path: Path, data: bytes, header: laspy.LasHeader) -> None:
    """Rejects impossible point counts before memory is allocated."""
    count, size = int(header.point_count), int(header.point_format.size)
    start = int(header.offset_to_point_data)
    if not header.are_points_compressed:
        if count * size > len(data) - start:
            raise FrameError(
                path,
                f"declares {count} points of {size} bytes, but only {len(data) - start} bytes of points follow",
                CLOUD_REMEDY,
            )
        return
    require_points(path, count)
    record = b"".join(record.record_data for record in header.vlrs.get("LasZipVlr")[:1])
    problem = laz_problem(data, LazLayout(record, int(header.point_format.id), size, count, start))
    if problem:
        raise FrameError(path, problem, CLOUD_REMEDY)


def _columns(path: Path, reader: laspy.LasReader) -> dict[str, np.ndarray]:
    count = int(reader.header.point_count)
    names = set(reader.header.point_format.dimension_names)
    columns = {name: np.empty(count) for name in "xyz"}
    bits = [name for name in ("intensity", "red", "green", "blue") if name in names]
    columns |= {name: np.empty(count, np.uint16) for name in bits}
    stored = {name: np.empty(count, np.int32) for name in "XYZ"}
    kept = np.ones(count, bool)
    for first in range(0, count, POINTS_AT_ONCE):
        points = reader.read_points(POINTS_AT_ONCE)
        if len(points) != min(POINTS_AT_ONCE, count - first):
            raise FrameError(path, f"declares {count} points but ends after {first + len(points)}", CLOUD_REMEDY)
        span = slice(first, first + len(points))
        for name, values in (columns | stored).items():
            # scale and offset of a damaged file may be any bits
            with np.errstate(all="ignore"):
                values[span] = np.asarray(points[name])
        kept[span] = np.asarray(points["withheld"]) == 0
    kept &= ~at_limits(path, [*stored.values()])
    # zeros throughout: not measured
    colors = {"red", "green", "blue"} if not any(columns[name].any() for name in bits[1:]) else set()
    unused = colors if columns["intensity"].any() else {*colors, "intensity"}
    return {name: values[kept] for name, values in columns.items() if name not in unused}
