"""LAS and LAZ point clouds, through laspy and lazrs (the extra `las`).

Format: ASPRS, "LAS Specification 1.4", R15. Coordinates are integers with a scale and an offset, usually map
coordinates in metres (`cloud_folder` moves the origin). Intensity and colours have 16 bits; some writers use fewer.

The decompressor of LAZ (lazrs) trusts what it reads: of damaged files it allocates the memory that their headers
declare, aborts the process, or reads memory that is not its own. So it runs in a process of its own with a limit of
memory, which is kept for further files, and ends with this one.
"""

from __future__ import annotations

import atexit
import io
import json
import os
import struct
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from annotator.frame_limits import frame_memory
from annotator.recordings.clouds.columns import CLOUD_REMEDY, RawCloud, at_limits, from_columns, require_points
from annotator.types.errors import FrameError, MissingExtraError

if TYPE_CHECKING:
    import laspy


Columns = dict[str, np.ndarray]
# Address space of Python with its libraries.
LIBRARIES_BYTES = 1 << 32
PROGRAM = (
    "import json, sys; sys.path[:] = json.loads(sys.stdin.buffer.readline()); "
    "from annotator.recordings.clouds import las_file; las_file.serve()"
)


class _Decoder:
    """The process; it is started when it is needed, and again after a crash."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = Lock()
        self._owner = 0
        atexit.register(self._end)

    def __call__(self, path: Path, data: bytes) -> Columns:
        with self._lock:
            try:
                return self._answer(path, data)
            except FrameError:
                raise
            except (OSError, EOFError, ValueError) as error:
                self._end()
                raise FrameError(path, "its points are damaged (the decoder crashed on them)", CLOUD_REMEDY) from error
            except BaseException:
                # interrupted: the answer is still to come
                self._end()
                raise

    def _answer(self, path: Path, data: bytes) -> Columns:
        # a fork of this process needs its own
        if self._process is None or self._owner != os.getpid():
            self._process, self._owner = _started(), os.getpid()
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps({"path": str(path), "bytes": len(data)}).encode() + b"\n" + data)
        self._process.stdin.flush()
        head = json.loads(self._process.stdout.readline())
        if "problem" in head:
            raise FrameError(path, head["problem"])
        columns = {name: np.empty(count, kind) for name, kind, count in head["columns"]}
        for values in columns.values():
            if _filled(self._process.stdout, values) < values.nbytes:
                raise EOFError
        return columns

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None and self._owner == os.getpid():
            process.kill()
            process.wait()
            for stream in (process.stdin, process.stdout):
                with suppress(OSError):
                    if stream is not None:
                        stream.close()


decode_laz = _Decoder()


def _started() -> subprocess.Popen[bytes]:
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", PROGRAM],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        # an interrupt at the terminal is for this process, which then ends the other
        process_group=0 if os.name != "nt" else None,
    )
    assert process.stdin is not None
    process.stdin.write(json.dumps(sys.path).encode() + b"\n")
    return process


def _filled(stream: IO[bytes], values: np.ndarray) -> int:
    """Fills an array with the bytes of a stream; returns how many there were."""
    place = values.data.cast("B") if values.nbytes else memoryview(b"")
    done = 0
    while done < values.nbytes and (count := stream.readinto(place[done:])):  # type: ignore[attr-defined]
        done += count
    return done


def serve() -> None:
    """Decodes what comes in, until there is no more."""
    if sys.platform != "win32":
        import resource

        most_bytes = LIBRARIES_BYTES + 2 * frame_memory()
        resource.setrlimit(resource.RLIMIT_AS, (most_bytes, most_bytes))
    out: Any = os.fdopen(os.dup(1), "wb")
    # what libraries print must not be taken for an answer
    os.dup2(2, 1)
    while line := sys.stdin.buffer.readline():
        asked = json.loads(line)
        data = sys.stdin.buffer.read(asked["bytes"])
        if len(data) < asked["bytes"]:
            return
        columns: Columns = {}
        try:
            columns = decode(Path(asked["path"]), data)
            head: dict[str, Any] = {"columns": [(name, each.dtype.str, len(each)) for name, each in columns.items()]}
        except FrameError as error:
            head = {"problem": str(error).removeprefix(f"{error.path}: ")}
        out.write(json.dumps(head).encode() + b"\n")
        for values in columns.values():
            out.write(values.tobytes())
        out.flush()


SIGNATURE = b"LASF"
# From byte 94: header size, offset of the points, number of records before them, point format, bytes per point, points.
HEAD_AT, HEAD = 94, struct.Struct("<HIIBHI")
SHORTEST_LAS_HEADER = 227
POINT_FORMAT_AT, COMPRESSED_BITS = 104, 0xC0
RECORD_HEAD_BYTES = 54
POINTS_AT_ONCE = 1 << 16


def parse_las(path: Path, data: bytes) -> RawCloud:
    """Parses the points of a LAS or LAZ file, without withheld ones; its unit is assumed to be metres."""
    try:
        import laspy  # noqa: F401
        import lazrs  # noqa: F401 - laspy imports it by itself, without an error if it is missing
    except ImportError as error:
        raise MissingExtraError("laspy[lazrs]", "las") from error
    _check_header(path, data)
    is_compressed = bool(data[POINT_FORMAT_AT] & COMPRESSED_BITS)
    return from_columns(path, decode_laz(path, data) if is_compressed else decode(path, data))


def decode(path: Path, data: bytes) -> dict[str, np.ndarray]:
    """Returns the columns of a file whose header was checked, in this process."""
    import laspy

    # layers that are not needed stay compressed
    layers = laspy.DecompressionSelection
    selection = layers.XY_RETURNS_CHANNEL | layers.Z | layers.INTENSITY | layers.RGB | layers.FLAGS
    try:
        with laspy.LasReader(
            io.BytesIO(data), laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False, decompression_selection=selection
        ) as reader:
            _check_points(path, data, reader.header)
            return _columns(path, reader)
    except FrameError:
        raise
    # for damaged files laspy raises any exception, and lazrs a PanicException, which is not an Exception
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise FrameError(path, f"cannot be read as LAS or LAZ ({str(error)[:100]})", CLOUD_REMEDY) from error


def _check_header(path: Path, data: bytes) -> None:
    """Rejects impossible record counts, which would keep laspy busy for hours."""
    if not data.startswith(SIGNATURE) or len(data) < SHORTEST_LAS_HEADER:
        raise FrameError(path, "is not a LAS file, or its header is truncated", CLOUD_REMEDY)
    header_bytes, start, records, _, point_bytes, _ = HEAD.unpack_from(data, HEAD_AT)
    if not SHORTEST_LAS_HEADER <= header_bytes <= start <= len(data) or point_bytes == 0:
        raise FrameError(
            path, f"the LAS header declares an impossible position of the points, byte {start}", CLOUD_REMEDY
        )
    if records * RECORD_HEAD_BYTES > start - header_bytes:
        raise FrameError(path, f"declares {records} records before its points, but fewer fit there", CLOUD_REMEDY)


def _check_points(path: Path, data: bytes, header: laspy.LasHeader) -> None:
    """Rejects impossible point counts before memory is allocated."""
    count, size = int(header.point_count), int(header.point_format.size)
    start = int(header.offset_to_point_data)
    if not header.are_points_compressed:
        if count * size > len(data) - start:
            raise FrameError(
                path,
                f"declares {count} points of {size} bytes, but only {len(data) - start} bytes of points follow",
                CLOUD_REMEDY,
            )
        return
    require_points(path, count)


def _columns(path: Path, reader: laspy.LasReader) -> dict[str, np.ndarray]:
    count = int(reader.header.point_count)
    names = set(reader.header.point_format.dimension_names)
    columns = {name: np.empty(count) for name in "xyz"}
    bits = [name for name in ("intensity", "red", "green", "blue") if name in names]
    columns |= {name: np.empty(count, np.uint16) for name in bits}
    stored = {name: np.empty(count, np.int32) for name in "XYZ"}
    kept = np.ones(count, bool)
    for first in range(0, count, POINTS_AT_ONCE):
        points = reader.read_points(POINTS_AT_ONCE)
        if len(points) != min(POINTS_AT_ONCE, count - first):
            raise FrameError(path, f"declares {count} points but ends after {first + len(points)}", CLOUD_REMEDY)
        span = slice(first, first + len(points))
        for name, values in (columns | stored).items():
            # scale and offset of a damaged file may be any bits
            with np.errstate(all="ignore"):
                values[span] = np.asarray(points[name])
        kept[span] = np.asarray(points["withheld"]) == 0
    kept &= ~at_limits(path, [*stored.values()])
    # zeros throughout: not measured
    colors = {"red", "green", "blue"} if not any(columns[name].any() for name in bits[1:]) else set()
    unused = colors if columns["intensity"].any() else {*colors, "intensity"}
    return {name: values[kept] for name, values in columns.items() if name not in unused}
