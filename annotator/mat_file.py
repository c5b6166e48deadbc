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
STEP_BYTES = 2**20


class MatFileError(ValueError):
    """Not a supported MATLAB file, or it does not contain the variable."""


class MatSizeError(MatFileError):
    """A variable that is larger than the limit."""


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
        data = read_file(path, most_bytes)
        if not _fits(data, most_bytes):
            raise MatSizeError(f"is larger than {most_bytes // 2**20} MiB")
        return fenced(f"{__name__}:load", data, name)
    except FenceError as error:
        raise MatFileError(str(error)) from error
    except OSError as error:
        if error.errno == errno.EFBIG:
            raise MatSizeError(f"is larger than {most_bytes // 2**20} MiB") from error
        raise


def _fits(data: bytes, most_bytes: int) -> bool:
    """Counts the bytes after decompression, without keeping them."""
    order, at = ">" if data[126:128] == b"MI" else "<", HEAD_BYTES
    while at + 8 <= len(data):
        kind, length = struct.unpack_from(order + "II", data, at)
        packed, at = data[at + 8 : at + 8 + length], at + 8 + length
        if kind == COMPRESSED:
            unpacking = zlib.decompressobj()
            try:
                while packed and not unpacking.eof:
                    most_bytes -= len(unpacking.decompress(packed, STEP_BYTES))
                    if most_bytes < 0:
                        return False
                    packed = unpacking.unconsumed_tail
            except zlib.error:
                return True  # scipy says what is wrong
    return True


def load(data: bytes, name: str) -> object:
    """As `read_mat`, in this process."""
    from scipy.io import loadmat

    if data[126:128] not in (b"IM", b"MI"):
        raise MatFileError("is not a MATLAB file of version 5 to 7; save it with -v7")
    try:
        found = loadmat(io.BytesIO(data), variable_names=[name])
    except MemoryError:
        raise
    except Exception as error:  # of a damaged file, scipy raises any
        raise MatFileError(f"is damaged ({str(error)[:80]})") from error
    if name not in found:
        raise MatFileError(f"has no variable {name}")
    return _plain(found[name], count())


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
