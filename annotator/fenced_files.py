"""Variables of MATLAB files and columns of Feather files, read in the `fence`.

scipy, which reads MATLAB's versions 5 to 7, crashes on some damaged files; pyarrow (the extra `argoverse`, used only
here) decompresses a file of some kilobytes to any size.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np

from annotator.fence import FenceError, fenced
from annotator.files import read_file
from annotator.frame_limits import memory_problem, read_frame_file
from annotator.types.errors import MissingExtraError


def read_mat(path: Path, name: str, most_bytes: int) -> object:
    """The variable `name` of a file: an array of numbers, a string, a list of a struct's or cell's elements, or None.

    The elements of a struct are dictionaries. None stands for other types, such as functions, and for strings of
    several lines.

    Raises:
        ValueError: damaged, of another version, no such variable, or one of more than `most_bytes` in memory.
        OSError: the file cannot be read, or is larger.
    """
    return fenced(f"{__name__}:load_mat", read_file(path, most_bytes), name, most_bytes)


# Memory of an element of a cell or struct, at least; SUN RGB-D's table has about 700,000.
ELEMENT_BYTES = 128


def load_mat(data: bytes, name: str, most_bytes: int) -> object:
    """As `read_mat`, in this process."""
    from scipy.io import loadmat

    if data[126:128] not in (b"IM", b"MI"):
        raise FenceError("is not a MATLAB file of version 5 to 7; save it with -v7")
    found = loadmat(io.BytesIO(data), variable_names=[name])
    if name not in found:
        raise FenceError(f"has no variable {name}")
    taken = 0

    def plain(value: Any) -> object:
        nonlocal taken
        taken += ELEMENT_BYTES + getattr(value, "nbytes", 0)
        # a file of some kilobytes unpacks to gigabytes
        if taken > most_bytes:
            raise FenceError(f"its {name} is larger than {most_bytes // 2**20} MiB in memory")
        if not isinstance(value, np.ndarray):
            return None
        if value.dtype.names is not None:
            return [{field: plain(row[field]) for field in value.dtype.names} for row in value.ravel(order="F")]
        if value.dtype.kind == "O":
            return [plain(each) for each in value.ravel(order="F")]
        if value.dtype.kind == "U":
            return "".join(value.ravel()) if value.size < 2 else None
        return value if value.dtype.kind in "biufc" else None

    return plain(found[name])


Kind = Literal["float", "int", "text"]
DTYPES = {"float": np.float64, "int": np.int64, "text": object}
ACCEPTED = {"float": "fiu", "int": "iu", "text": "OU"}
MAGIC = b"ARROW1"


def read_feather(path: Path, columns: Mapping[str, Kind]) -> dict[str, np.ndarray]:
    """Returns columns of equal length: float64, int64, or objects (texts).

    Raises:
        FenceError: a damaged file, or a column that is missing, of another kind, empty in a row, or not finite.
    """
    if find_spec("pyarrow") is None:
        raise MissingExtraError("pyarrow", "argoverse")
    data = read_frame_file(path)
    if not (data.startswith(MAGIC) and data.endswith(MAGIC)):
        raise FenceError("is not a Feather file of version 2, or damaged")
    present, raw = fenced(f"{__name__}:load_columns", data, list(columns))
    missing = [name for name in columns if name not in present]
    if missing:
        raise FenceError(f"has no column {' '.join(missing)} (its columns: {', '.join(present) or 'none'})")
    for name, kind in columns.items():
        if name not in raw or raw[name].dtype.kind not in ACCEPTED[kind]:
            raise FenceError(f"the column {name} must hold a {kind} in every row")
    result = {name: raw[name].astype(DTYPES[kind]) for name, kind in columns.items()}
    broken = [name for name, kind in columns.items() if kind == "float" and not np.isfinite(result[name]).all()]
    if broken:
        raise FenceError(f"the column {broken[0]} has a number that is not finite")
    return result


def load_columns(data: bytes, names: list[str]) -> tuple[list[str], dict[str, np.ndarray]]:
    """Returns the names of all columns, and those of `names` that have a value in every row."""
    import pyarrow
    import pyarrow.ipc

    try:
        options = pyarrow.ipc.IpcReadOptions(use_threads=False)
        table = pyarrow.ipc.open_file(pyarrow.py_buffer(data), options=options).read_all()
        if problem := memory_problem(points=table.num_rows, more_bytes=table.nbytes):
            raise FenceError(problem)
        table.validate(full=True)
        found = {name: table.column(name) for name in names if name in table.column_names}
        raw = {name: column.to_numpy(zero_copy_only=False) for name, column in found.items() if not column.null_count}
    except (FenceError, MemoryError):
        raise
    # of a damaged file, pyarrow raises any of these, with messages for programmers
    except (pyarrow.ArrowException, OSError, ValueError, KeyError) as error:
        raise FenceError(f"is not a Feather file, or damaged ({str(error).splitlines()[0][:80]})") from error
    return table.column_names, raw
