"""Columns of Feather files (Apache Arrow); the only user of pyarrow, which is the extra `argoverse`.

pyarrow decompresses a file of some kilobytes to any size. So the messages that hold the columns are listed first, with
the sizes that they declare. Format: "Arrow Columnar Format" (arrow.apache.org), "Serialization and Interprocess
Communication" and Message.fbs, a FlatBuffers schema. A file is a stream of messages, and a list of their places that is
not used here.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from annotator.frame_limits import memory_problem, read_frame_file
from annotator.types.errors import MissingExtraError

Kind = Literal["float", "int", "text"]
DTYPES = {"float": np.float64, "int": np.int64, "text": object}
ACCEPTED = {"float": "fiu", "int": "iu", "text": "OU"}


MAGIC, STREAM_AT = b"ARROW1", 8
DICTIONARY, BATCH = 2, 3
# An uncompressed buffer within a compressed batch.
AS_IT_IS = -1


class FeatherError(ValueError):
    """A file that is damaged or lacks a column; the message does not name the file."""


def read_feather(path: Path, columns: Mapping[str, Kind]) -> dict[str, np.ndarray]:
    """Returns columns of equal length: float64, int64, or objects (texts).

    Raises:
        MissingExtraError: pyarrow is not installed.
        FeatherError: a damaged file, or a column that is missing, of another kind, empty in a row, or not finite.
        OSError: the file cannot be read.
    """
    try:
        import pyarrow
        import pyarrow.ipc
    except ImportError as error:
        raise MissingExtraError("pyarrow", "argoverse") from error
    data = read_frame_file(path)
    if not (data.startswith(MAGIC) and data.endswith(MAGIC)):
        raise FeatherError("is not a Feather file of version 2, or damaged")
    stream = pyarrow.py_buffer(data)[STREAM_AT:]
    try:
        rows, size = _declared(pyarrow.ipc.MessageReader.open_stream(stream))
        problem = memory_problem(points=rows, more_bytes=size)
        if problem:
            raise FeatherError(problem)
        table = pyarrow.ipc.open_stream(stream, options=pyarrow.ipc.IpcReadOptions(use_threads=False)).read_all()
        table.validate(full=True)
        found = {name: table.column(name) for name in columns if name in table.column_names}
        raw = {name: column.to_numpy(zero_copy_only=False) for name, column in found.items() if not column.null_count}
    except FeatherError:
        raise
    # of a damaged file, pyarrow raises any of these, with messages for programmers
    except (pyarrow.ArrowException, OSError, ValueError, MemoryError, KeyError, struct.error) as error:
        raise FeatherError(f"is not a Feather file, or damaged ({str(error).splitlines()[0][:80]})") from error
    missing = [name for name in columns if name not in found]
    if missing:
        present = ", ".join(table.column_names) or "none"
        raise FeatherError(f"has no column {' '.join(missing)} (its columns: {present})")
    for name, kind in columns.items():
        if name not in raw or raw[name].dtype.kind not in ACCEPTED[kind]:
            raise FeatherError(f"the column {name} must hold a {kind} in every row")
    result = {name: raw[name].astype(DTYPES[kind]) for name, kind in columns.items()}
    broken = [name for name, kind in columns.items() if kind == "float" and not np.isfinite(result[name]).all()]
    if broken:
        raise FeatherError(f"the column {broken[0]} has a number that is not finite")
    return result


def _declared(messages: Any) -> tuple[int, int]:
    """Returns the number of rows, and of bytes after decompression.

    Raises:
        struct.error: a message is damaged.
    """
    rows = size = 0
    while True:
        try:
            message = messages.read_next_message()
        except StopIteration:
            return rows, size
        meta, body = memoryview(message.metadata), memoryview(message.body or b"")
        # Message: version, header_type, header, ...
        top = struct.unpack_from("<I", meta)[0]
        kind, batch = _field(meta, top, 1), _linked(meta, top, 2)
        if kind is None or batch is None or meta[kind] not in (DICTIONARY, BATCH):
            continue
        if meta[kind] == DICTIONARY:
            # DictionaryBatch: id, data, ...
            batch = _linked(meta, batch, 1)
        if batch is None:
            continue
        # RecordBatch: length, nodes, buffers, compression, ...
        length, buffers = _field(meta, batch, 0), _linked(meta, batch, 2)
        rows += 0 if length is None else max(struct.unpack_from("<q", meta, length)[0], 0)
        is_compressed = _linked(meta, batch, 3) is not None
        count = 0 if buffers is None else struct.unpack_from("<I", meta, buffers)[0]
        for number in range(count):
            start, stored = struct.unpack_from("<qq", meta, (buffers or 0) + 4 + 16 * number)
            full = struct.unpack_from("<q", body, start)[0] if is_compressed and stored > 0 else AS_IT_IS
            size += max(stored if full == AS_IT_IS else full, 0)


def _field(meta: memoryview, table: int, number: int) -> int | None:
    """Returns the place of a field of a FlatBuffers table; None if it has its default."""
    fields = table - struct.unpack_from("<i", meta, table)[0]
    if 6 + 2 * number > struct.unpack_from("<H", meta, fields)[0]:
        return None
    offset = struct.unpack_from("<H", meta, fields + 4 + 2 * number)[0]
    return table + offset if offset else None


def _linked(meta: memoryview, table: int, number: int) -> int | None:
    """Returns the place of the table or vector that a field leads to."""
    place = _field(meta, table, number)
    return None if place is None else place + int(struct.unpack_from("<I", meta, place)[0])
