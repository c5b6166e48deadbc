"""Variables of MATLAB files, versions 5 to 7, through scipy, which crashes on some damaged ones (`fence`)."""

from __future__ import annotations

import errno
import io
import struct
import zlib
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from annotator.fence import FenceError, fenced
from annotator.files import read_file

HEAD_BYTES, COMPRESSED = 128, 15
# Elements of cells and structs, each of which becomes an object; SUN RGB-D's table has about 700,000.
MOST_OBJECTS = 2**21


class MatFileError(ValueError):
    """Not a supported MATLAB file, or it does not contain the variable."""


def read_mat(path: Path, name: str, most_bytes: int) -> object:
    """The variable `name` of a file: an array of numbers, a string, a list of a struct's or cell's elements, or None.

    The elements of a struct are dictionaries. None stands for other types, such as functions, and for strings of
    several lines.

    Args:
        most_bytes: size limit of the file, also after decompression.

    Raises:
        MatFileError: too large, damaged, of another version, or no such variable.
        OSError: the file cannot be read.
    """
    try:
        return fenced(f"{__name__}:load", read_file(path, most_bytes), name, most_bytes)
    except FenceError as error:
        raise MatFileError(str(error)) from error
    except OSError as error:
        if error.errno == errno.EFBIG:
            raise _too_large(most_bytes) from error
        raise


def load(data: bytes, name: str, most_bytes: int) -> object:
    """As `read_mat`, in this process."""
    from scipy.io import loadmat

    if data[126:128] not in (b"IM", b"MI"):
        raise MatFileError("is not a MATLAB file of version 5 to 7; save it with -v7")
    try:
        found = loadmat(io.BytesIO(_unpacked(data, most_bytes)), variable_names=[name])
    except (MatFileError, MemoryError):
        raise
    except Exception as error:  # of a damaged file, scipy raises any
        raise MatFileError(f"is damaged ({str(error)[:80]})") from error
    if name not in found:
        raise MatFileError(f"has no variable {name}")
    return _plain(found[name], count())


def _unpacked(data: bytes, most_bytes: int) -> bytes:
    """Returns a file without its compression, which scipy would undo without a limit."""
    head = struct.Struct(">II" if data[126:128] == b"MI" else "<II")
    view, at, left = memoryview(data), HEAD_BYTES, most_bytes
    parts: list[bytes | memoryview] = [view[:at]]
    while at + head.size <= len(data):
        kind, length = head.unpack_from(data, at)
        element: bytes | memoryview = view[at : at + head.size + length]
        at += len(element)
        if kind == COMPRESSED:
            element = zlib.decompressobj().decompress(element[head.size :], left + 1)
            left -= len(element)
            if left < 0:
                raise _too_large(most_bytes)
            end = head.size + head.unpack_from(element)[1]
            if end > len(element):
                raise MatFileError("is damaged (a variable is cut off)")
            element = element[:end]
        parts.append(element)
    return b"".join(parts)


def _too_large(most_bytes: int) -> MatFileError:
    return MatFileError(f"is larger than {most_bytes // 2**20} MiB")


def _plain(value: Any, objects: Iterator[int]) -> object:
    if next(objects) > MOST_OBJECTS:
        raise MatFileError(f"has more than {MOST_OBJECTS} elements of cells and structs")
    if not isinstance(value, np.ndarray):
        return None
    if value.dtype.names is not None:
        fields = value.dtype.names
        return [{field: _plain(row[field], objects) for field in fields} for row in value.ravel(order="F")]
    if value.dtype.kind == "O":
        return [_plain(each, objects) for each in value.ravel(order="F")]
    if value.dtype.kind == "U":
        return "".join(value.ravel()) if value.size < 2 else None
    return value if value.dtype.kind in "biufc" else None
