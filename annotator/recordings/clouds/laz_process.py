"""Decodes LAZ in a process of its own.

On some damaged points, which no header shows, the decoder (lazrs 0.8.2) reads memory that is not its own, and the
system ends its process. That must not be the server. The process is kept for further files, and ends with this one.
"""

from __future__ import annotations

import atexit
import json
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import IO, Any

import numpy as np

from annotator.recordings.clouds.columns import CLOUD_REMEDY
from annotator.types.errors import FrameError

Columns = dict[str, np.ndarray]
PROGRAM = (
    "import json, sys; sys.path[:] = json.loads(sys.stdin.buffer.readline()); "
    "from annotator.recordings.clouds import las_file, laz_process; laz_process.serve(las_file.decode)"
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


def serve(decode: Callable[[Path, bytes], Columns]) -> None:
    """Decodes what comes in, until there is no more."""
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
