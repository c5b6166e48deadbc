"""Columns of Feather files (Apache Arrow); the only user of pyarrow, which is the extra `argoverse`.

pyarrow decompresses a file of some kilobytes to any size, so it runs in the `fence`.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import numpy as np

from annotator.fence import FenceError, fenced
from annotator.frame_limits import memory_problem, read_frame_file
from annotator.types.errors import MissingExtraError

Kind = Literal["float", "int", "text"]
DTYPES = {"float": np.float64, "int": np.int64, "text": object}
ACCEPTED = {"float": "fiu", "int": "iu", "text": "OU"}


MAGIC = b"ARROW1"


class FeatherError(ValueError):
    """A file that is damaged or lacks a column; the message does not name the file."""


def read_feather(path: Path, columns: Mapping[str, Kind]) -> dict[str, np.ndarray]:
    """Returns columns of equal length: float64, int64, or objects (texts).

    Raises:
        MissingExtraError: pyarrow is not installed.
        FeatherError: a damaged file, or a column that is missing, of another kind, empty in a row, or not finite.
        OSError: the file cannot be read.
    """
    if find_spec("pyarrow") is None:
        raise MissingExtraError("pyarrow", "argoverse")
    data = read_frame_file(path)
    if not (data.startswith(MAGIC) and data.endswith(MAGIC)):
        raise FeatherError("is not a Feather file of version 2, or damaged")
    try:
        present, raw = fenced(f"{__name__}:load", data, list(columns))
    except FenceError as error:
        raise FeatherError(str(error)) from error
    missing = [name for name in columns if name not in present]
    if missing:
        raise FeatherError(f"has no column {' '.join(missing)} (its columns: {', '.join(present) or 'none'})")
    for name, kind in columns.items():
        if name not in raw or raw[name].dtype.kind not in ACCEPTED[kind]:
            raise FeatherError(f"the column {name} must hold a {kind} in every row")
    result = {name: raw[name].astype(DTYPES[kind]) for name, kind in columns.items()}
    broken = [name for name, kind in columns.items() if kind == "float" and not np.isfinite(result[name]).all()]
    if broken:
        raise FeatherError(f"the column {broken[0]} has a number that is not finite")
    return result


def load(data: bytes, names: list[str]) -> tuple[list[str], dict[str, np.ndarray]]:
    """Returns the names of all columns, and those of `names` that have a value in every row."""
    import pyarrow
    import pyarrow.ipc

    try:
        options = pyarrow.ipc.IpcReadOptions(use_threads=False)
        table = pyarrow.ipc.open_file(pyarrow.py_buffer(data), options=options).read_all()
        if problem := memory_problem(points=table.num_rows, more_bytes=table.nbytes):
            raise FeatherError(problem)
        table.validate(full=True)
        found = {name: table.column(name) for name in names if name in table.column_names}
        raw = {name: column.to_numpy(zero_copy_only=False) for name, column in found.items() if not column.null_count}
    except (FeatherError, MemoryError):
        raise
    # of a damaged file, pyarrow raises any of these, with messages for programmers
    except (pyarrow.ArrowException, OSError, ValueError, KeyError) as error:
        raise FeatherError(f"is not a Feather file, or damaged ({str(error).splitlines()[0][:80]})") from error
    return table.column_names, raw
