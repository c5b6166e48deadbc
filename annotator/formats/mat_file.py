"""Struct arrays in MATLAB files of version 5 to 7, read with bounded memory.

"MATLAB, MAT-File Format": a head of 128 bytes, then elements of a type and a length, of which type 15 is a zlib stream.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np

from annotator.types.errors import FormatError

# SUN RGB-D's largest has some ten thousand frames in less than a tenth of this.
MAX_BYTES = 2**29
HEAD_BYTES = 128
COMPRESSED = 15
CHUNK = 2**20
REMEDY = "save it with version 5 to 7 of MATLAB's format (save -v7)"


def read_struct_array(path: Path, name: str) -> np.ndarray:
    """The struct array `name` of a file, a record an element; nothing in it is executed.

    Raises:
        FormatError: the file is missing, too large when unpacked, damaged, or has no such struct array.
    """
    from scipy.io import loadmat

    _require_bounded(path)
    try:
        variables = loadmat(str(path), variable_names=[name])
    # the reader raises whatever a damaged file leads it to
    except Exception as error:
        raise FormatError(path, f"cannot be read as a MATLAB file ({str(error)[:100]}); {REMEDY}") from error
    table = variables.get(name)
    if not isinstance(table, np.ndarray) or table.dtype.names is None:
        raise FormatError(path, f"has no struct array {name}")
    return table


def _require_bounded(path: Path) -> None:
    """Unpacks the file once without keeping anything, so that no small file fills the memory."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise FormatError(path, f"is larger than {MAX_BYTES // 2**20} MiB")
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
            if len(head) < HEAD_BYTES or head[126:] not in (b"IM", b"MI"):
                raise FormatError(path, f"is no MATLAB file that can be read; {REMEDY}")
            order, left = "<" if head[126:] == b"IM" else ">", MAX_BYTES
            while len(tag := file.read(8)) == 8:
                kind, length = struct.unpack(order + "II", tag)
                if kind == COMPRESSED:
                    left -= _unpacked(file.read(length), left)
                else:
                    file.seek(length, 1)
                if left <= 0:
                    raise FormatError(path, f"is larger than {MAX_BYTES // 2**20} MiB when unpacked")
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})") from error
    except zlib.error as error:
        raise FormatError(path, f"is damaged ({error}); {REMEDY}") from error


def _unpacked(data: bytes, most: int) -> int:
    """How many bytes a zlib stream holds; counting ends at `most`."""
    stream, count = zlib.decompressobj(), 0
    while data and count < most:
        count += len(stream.decompress(data, CHUNK))
        data = stream.unconsumed_tail
    return count
