"""Reads a point cloud file of any supported format.

NumPy arrays (`.npy`; `.npz` with an array of points and optionally one of colours) are n x 3 (x y z), n x 4 (with
reflectance), n x 6 (with colours), or have named fields. Nothing is unpickled. Headers are checked against the file's
size before memory is allocated. Format: NEP 1 and `numpy.lib.format`.
"""

from __future__ import annotations

import codecs
import io
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from annotator.files import ARCHIVE_ERRORS, open_archive
from annotator.frame_limits import read_frame_file
from annotator.recordings.clouds.columns import (
    CLOUD_REMEDY,
    RawCloud,
    field_columns,
    files_like,
    from_columns,
    require_points,
)
from annotator.recordings.clouds.las_file import parse_las
from annotator.recordings.clouds.pcd_ply import parse_pcd, parse_ply
from annotator.recordings.scan_file import SCAN_SUFFIX, Scans
from annotator.types.errors import FrameError

POINT_NAMES = ("points", "xyz", "xyz_m", "pc", "cloud", "arr_0")
COLOR_ARRAY_NAMES = ("colors", "colours", "rgb", "color")
COLUMNS = {3: "x y z", 4: "x y z reflectance", 6: "x y z red green blue"}
# Members of archives are typed as IO[bytes], files in memory are BufferedIOBase.
Stream = IO[bytes] | io.BufferedIOBase


def parse_npy(path: Path, data: bytes) -> RawCloud:
    """Parses the points of an `.npy` file."""
    return from_columns(path, _columns(path, read_array(path, io.BytesIO(data), len(data))))


def parse_npz(path: Path, data: bytes) -> RawCloud:
    """Parses the points, and the colours if there are any, of an `.npz` file."""
    try:
        with open_archive(io.BytesIO(data)) as archive:
            names = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            points = next((names[name] for name in POINT_NAMES if name in names), None)
            if points is None:
                raise FrameError(
                    path, f"has no array {' or '.join(POINT_NAMES)} (its arrays: {_first_names(names)})", CLOUD_REMEDY
                )
            columns = _columns(path, _member(path, archive, points))
            colors = next((names[name] for name in COLOR_ARRAY_NAMES if name in names), None)
            if colors is not None:
                columns |= _color_columns(path, _member(path, archive, colors), len(columns["x"]))
    except ARCHIVE_ERRORS as error:
        raise FrameError(path, f"the archive is damaged ({error})", CLOUD_REMEDY) from error
    return from_columns(path, columns)


def _member(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(info) as file:
        return read_array(path, file, info.file_size)


def read_array(path: Path, file: Stream, size: int, *, is_image: bool = False) -> np.ndarray:
    """Reads the array of an `.npy` file at the position of `file`, which holds `size` bytes.

    Args:
        is_image: each value gives a point; otherwise, each row does.
    """
    try:
        shape, is_fortran, dtype = _header(file)
    # the header is a Python expression: a damaged one can raise any exception
    except Exception as error:
        raise FrameError(path, f"the header of its array is damaged ({str(error)[:80]})", CLOUD_REMEDY) from error
    is_readable = dtype.kind in "fiu" or (dtype.names is not None and not dtype.hasobject)
    if not is_readable or dtype.itemsize == 0 or any(length < 0 for length in shape):
        raise FrameError(path, f"its array holds {dtype}, not numbers", CLOUD_REMEDY)
    count = 1
    for length in shape:
        count *= int(length)
    if count * dtype.itemsize > size:
        raise FrameError(
            path, f"its array declares {count} values of {dtype.itemsize} bytes but has {size} bytes", CLOUD_REMEDY
        )
    require_points(path, count if is_image else min(count, *shape[:1]), more_bytes=count * dtype.itemsize)
    content = file.read(count * dtype.itemsize)
    if len(content) < count * dtype.itemsize:
        raise FrameError(path, "its array is truncated", CLOUD_REMEDY)
    try:
        return np.frombuffer(content, dtype).reshape(shape, order="F" if is_fortran else "C")
    except ValueError as error:
        # an empty array may still declare too many or too long dimensions
        raise FrameError(path, f"its array has an impossible shape ({error})", CLOUD_REMEDY) from error


def _header(file: Stream) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Returns an array's shape, True for Fortran order, and its type."""
    version = npy.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"version {version[0]}.{version[1]}")
    with warnings.catch_warnings():
        # numpy warns about headers written by Python 2
        warnings.simplefilter("ignore")
        header = npy.read_array_header_1_0(file) if version == (1, 0) else npy.read_array_header_2_0(file)
    shape, is_fortran, dtype = header
    return tuple(int(length) for length in shape), bool(is_fortran), dtype


def _columns(path: Path, array: np.ndarray) -> dict[str, np.ndarray]:
    if array.dtype.names is not None:
        if array.ndim != 1:
            raise FrameError(
                path, f"its array of points has the shape {array.shape}", "save a one-dimensional array of rows"
            )
        return field_columns(array)
    if array.ndim != 2 or array.shape[1] not in COLUMNS:
        raise FrameError(
            path,
            f"its array of points has the shape {array.shape}",
            "save n x 3 (x y z), n x 4 (with reflectance) or n x 6 numbers (with colours)",
        )
    names = COLUMNS[array.shape[1]].split()
    if "red" not in names:
        return {name: array[:, column] for column, name in enumerate(names)}
    return {"x": array[:, 0], "y": array[:, 1], "z": array[:, 2], **_color_columns(path, array[:, 3:], len(array))}


def _color_columns(path: Path, colors: np.ndarray, points: int) -> dict[str, np.ndarray]:
    if colors.dtype.names is not None or colors.shape != (points, 3):
        raise FrameError(path, f"its colours have the shape {colors.shape}, for {points} points", "save n x 3 colours")
    return dict(zip(("red", "green", "blue"), colors.T, strict=True))


def _first_names(names: dict[str, zipfile.ZipInfo]) -> str:
    return ", ".join(sorted(names)[:5]) or "none"


PARSERS: dict[str, Callable[[Path, bytes], RawCloud]] = {
    ".ply": parse_ply,
    ".pcd": parse_pcd,
    ".npy": parse_npy,
    ".npz": parse_npz,
    ".las": parse_las,
    ".laz": parse_las,
}
CLOUD_SUFFIXES = (*PARSERS, SCAN_SUFFIX)


def read_cloud(path: Path, scans: Scans | None = None) -> RawCloud:
    """Returns the valid points of a file with one of `CLOUD_SUFFIXES`, in its own frame, metres.

    Args:
        scans: reads `.bin` files, and has the scale of reflectance; None = this file alone decides.
    """
    if path.suffix.lower() == SCAN_SUFFIX:
        return (scans or Scans()).read(path)
    raw = _parsed(path)
    return raw if scans is None else scans.scale.apply(path.parent, raw, lambda: files_like(path), _parsed)


def _parsed(path: Path) -> RawCloud:
    try:
        data = read_frame_file(path)
    except OSError as error:
        raise FrameError(path, f"cannot be read ({error.strerror})", CLOUD_REMEDY) from error
    if not data:
        raise FrameError(path, "the file is empty", CLOUD_REMEDY)
    # headers that an editor has saved
    return PARSERS[path.suffix.lower()](path, data.removeprefix(codecs.BOM_UTF8))
