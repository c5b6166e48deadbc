"""Variables of MATLAB files, versions 5 to 7, through scipy, which crashes on some damaged ones (`fence`)."""

from __future__ import annotations

import errno
import io
from pathlib import Path
from typing import Any

import numpy as np

from annotator.fence import FenceError, fenced
from annotator.files import read_file


class MatFileError(ValueError):
    """Not a supported MATLAB file, or it does not contain the variable."""


def read_mat(path: Path, name: str, most_bytes: int) -> object:
    """The variable `name` of a file: an array of numbers, a string, a list of a struct's or cell's elements, or None.

    The elements of a struct are dictionaries. None stands for other types, such as functions, and for strings of
    several lines.

    Args:
        most_bytes: size limit of the file.

    Raises:
        MatFileError: too large, damaged, of another version, or no such variable.
        OSError: the file cannot be read.
    """
    try:
        return fenced(f"{__name__}:load", read_file(path, most_bytes), name)
    except FenceError as error:
        raise MatFileError(str(error)) from error
    except OSError as error:
        if error.errno == errno.EFBIG:
            raise MatFileError(f"is larger than {most_bytes // 2**20} MiB") from error
        raise


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
    return _plain(found[name])


def _plain(value: Any) -> object:
    if not isinstance(value, np.ndarray):
        return None
    if value.dtype.names is not None:
        return [{field: _plain(row[field]) for field in value.dtype.names} for row in value.ravel(order="F")]
    if value.dtype.kind == "O":
        return [_plain(each) for each in value.ravel(order="F")]
    if value.dtype.kind == "U":
        return "".join(value.ravel()) if value.size < 2 else None
    return value if value.dtype.kind in "biufc" else None
