"""Reads a point cloud file of any supported format.

NumPy arrays (`.npy`; `.npz` with an array of points and optionally one of colours) are n x 3 (x y z), n x 4 (with
reflectance), n x 6 (with colours), or have named fields. Nothing is unpickled. Headers are checked against the file's
size before memory is allocated. Format: NEP 1 and `numpy.lib.format`.
"""

from __future__ import annotations

import codecs
import io
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from annotator.files import ARCHIVE_ERRORS, open_archive
from annotator.frame_limits import read_frame_file, require_memory
from annotator.recordings.clouds.columns import (
    CLOUD_REMEDY,
    RawCloud,
    field_columns,
    files_like,
    from_columns,
)
from annotator.recordings.clouds.las_file import parse_las
from annotator.recordings.clouds.pcd_ply import parse_pcd, parse_ply
from annotator.recordings.listing import file_errors
from annotator.recordings.scan_file import SCAN_SUFFIX, Scans

POINT_NAMES = ("points", "xyz", "xyz_m", "pc", "cloud", "arr_0")
COLOR_NAMES = ("colors", "colours", "rgb", "color")
COLUMNS = {3: "x y z", 4: "x y z reflectance", 6: "x y z red green blue"}


def parse_npy(data: bytes) -> RawCloud:
    """Parses the points of an `.npy` file."""
    return from_columns(_columns(read_array(io.BytesIO(data))))


def parse_npz(data: bytes) -> RawCloud:
    """Parses the points, and the colours if there are any, of an `.npz` file."""
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
    """Returns the array of an `.npy` file, or of a member of an archive.

    Args:
        is_image: each value gives a point; otherwise, each row does.

    Raises:
        ValueError: it is damaged, too large, or has no numbers.
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
    with file_errors(path, CLOUD_REMEDY):
        data = read_frame_file(path)
        if not data:
            raise ValueError("the file is empty")
        # headers that an editor has saved
        return PARSERS[path.suffix.lower()](data.removeprefix(codecs.BOM_UTF8))
