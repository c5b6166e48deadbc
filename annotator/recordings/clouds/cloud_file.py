"""Reads a point cloud file of any supported format.

NumPy arrays (`.npy`; `.npz` with an array of points and optionally one of colours) are n x 3 (x y z), n x 4 (with
reflectance), n x 6 (with colours), or have named fields. Nothing is unpickled. Format: NEP 1 and `numpy.lib.format`.

LAS and LAZ are read by laspy and lazrs (the extra `las`). Format: ASPRS, "LAS Specification 1.4", R15. Coordinates are
integers with a scale and an offset, usually map coordinates in metres (`cloud_folder` moves the origin). Intensity and
colours have 16 bits; some writers use fewer. The decompressor of LAZ trusts what it reads, so it runs in the `fence`.
"""

from __future__ import annotations

import codecs
import io
import struct
import warnings
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from annotator.fence import fenced
from annotator.files import ARCHIVE_ERRORS, open_archive
from annotator.frame_limits import read_frame_file, require_memory
from annotator.recordings.clouds.columns import (
    CLOUD_REMEDY,
    RawCloud,
    at_limits,
    field_columns,
    files_like,
    from_columns,
)
from annotator.recordings.clouds.pcd_ply import parse_pcd, parse_ply
from annotator.recordings.listing import file_errors
from annotator.recordings.scan_file import SCAN_SUFFIX, Scans
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
    """Returns the columns of a file whose header was checked, in this process: coordinates also as they are stored."""
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


POINT_NAMES = ("points", "xyz", "xyz_m", "pc", "cloud", "arr_0")
COLOR_NAMES = ("colors", "colours", "rgb", "color")
COLUMNS = {3: "x y z", 4: "x y z reflectance", 6: "x y z red green blue"}


def parse_npz(data: bytes) -> RawCloud:
    try:
        with open_archive(io.BytesIO(data)) as archive:
            infos = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            # other arrays may be of any kind, and large
            points, colors = (next((n for n in names if n in infos), "") for names in (POINT_NAMES, COLOR_NAMES))
            used = [infos[name] for name in (points, colors) if points and name]
            require_memory(more_bytes=sum(info.file_size for info in used))
            arrays = [read_array(archive.open(info)) for info in used]
    except ARCHIVE_ERRORS as error:
        raise ValueError(f"its archive cannot be read ({error})") from error
    if not arrays:
        present = ", ".join(sorted(infos)[:5]) or "none"
        raise ValueError(f"has no array {' or '.join(POINT_NAMES)} (its arrays: {present})")
    columns = _columns(arrays[0])
    for each in arrays[1:]:
        columns |= _color_columns(each, len(columns["x"]))
    return from_columns(columns)


def read_array(file: IO[bytes], *, is_image: bool = False) -> np.ndarray:
    """Returns the array of an `.npy` file, or of a member of an archive; a ValueError says that it is damaged or large.

    `is_image`: each value gives a point; otherwise, each row does.
    """
    with warnings.catch_warnings():
        # numpy warns about headers written by Python 2
        warnings.simplefilter("ignore")
        try:
            array = npy.read_array(file, allow_pickle=False)
        # the header is a Python expression: a damaged one can raise any exception, and declare any size
        except Exception as error:
            raise ValueError(f"its array is damaged ({str(error)[:80]})") from error
    require_memory(points=array.size if is_image else len(array) if array.ndim else 1, more_bytes=array.nbytes)
    if array.dtype.kind not in "fiu" and array.dtype.names is None:
        raise ValueError(f"its array holds {array.dtype}, not numbers")
    return array


def _columns(array: np.ndarray) -> dict[str, np.ndarray]:
    if array.dtype.names is not None:
        if array.ndim != 1:
            raise ValueError(f"its array of points has the shape {array.shape}; save a one-dimensional array of rows")
        return field_columns(array)
    if array.ndim != 2 or array.shape[1] not in COLUMNS:
        raise ValueError(f"its array of points has the shape {array.shape}, not n x 3, 4 (reflectance) or 6 (colours)")
    names = COLUMNS[array.shape[1]].split()
    if "red" not in names:
        return {name: array[:, column] for column, name in enumerate(names)}
    return {"x": array[:, 0], "y": array[:, 1], "z": array[:, 2], **_color_columns(array[:, 3:], len(array))}


def _color_columns(colors: np.ndarray, points: int) -> dict[str, np.ndarray]:
    if colors.dtype.names is not None or colors.shape != (points, 3):
        raise ValueError(f"its colours have the shape {colors.shape}, for {points} points; save n x 3 colours")
    return dict(zip(("red", "green", "blue"), colors.T, strict=True))


PARSERS: dict[str, Callable[[bytes], RawCloud]] = {
    ".ply": parse_ply,
    ".pcd": parse_pcd,
    ".npy": lambda data: from_columns(_columns(read_array(io.BytesIO(data)))),
    ".npz": parse_npz,
    ".las": parse_las,
    ".laz": parse_las,
}
CLOUD_SUFFIXES = (*PARSERS, SCAN_SUFFIX)


def read_cloud(path: Path, scans: Scans | None = None) -> RawCloud:
    """Returns the valid points of a file with one of `CLOUD_SUFFIXES`, in its own frame, metres.

    `scans` reads `.bin` files, and has the scale of reflectance; None = this file alone decides.
    """
    if path.suffix.lower() == SCAN_SUFFIX:
        return (scans or Scans()).read(path)
    raw = _parsed(path)
    return raw if scans is None else scans.scale.apply(path.parent, raw, lambda: files_like(path), _parsed)


def _parsed(path: Path) -> RawCloud:
    with file_errors(path, CLOUD_REMEDY):
        data = read_frame_file(path)
        if not data:
            raise ValueError("the file is empty")
        # headers that an editor has saved
        return PARSERS[path.suffix.lower()](data.removeprefix(codecs.BOM_UTF8))
