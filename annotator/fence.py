"""The fence around libraries that trust what they read: a process of its own, with limits of memory and time.

Decoders of LAZ (lazrs), MATLAB files (scipy), LZFSE and Feather (pyarrow) crash on some damaged files, or allocate what
a header declares; that of H.264 video has one log for all threads. So they run in another process, which is kept for
further files, started again after a crash, and ends with this one.
"""

from __future__ import annotations

import atexit
import os
import pickle
import subprocess
import sys
from contextlib import suppress
from importlib import import_module
from threading import Lock, Timer
from typing import IO, Any

from annotator.frame_limits import VARIABLE, frame_memory

# Address space of Python with its libraries.
LIBRARIES_BYTES = 1 << 32
# The largest clouds take some seconds.
MOST_S = 120.0
SETTINGS = {
    # each thread of OpenBLAS, which decoders do not need, would take address space
    "OPENBLAS_NUM_THREADS": "1",
    # glibc keeps so much memory for the next file: new pages took a quarter of the time of a cloud of SUN RGB-D
    "MALLOC_MMAP_THRESHOLD_": str(1 << 25),
    "MALLOC_TRIM_THRESHOLD_": str(1 << 26),
}
# What users may set.
PIPE_BYTES = 1 << 20
PROGRAM = "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); from annotator import fence; fence.serve()"


class FenceError(ValueError):
    """A decoder crashed, took too long or too much memory, or failed; the message says which."""


class _Fence:
    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = Lock()
        self._state = (0, 0)
        atexit.register(self._end)

    def __call__(self, function: str, *values: Any) -> Any:
        """Calls a function of a module (`annotator.module:function`) in the process; values and result are pickled.

        Raises:
            ValueError: raised by the function, or a FenceError.
        """
        with self._lock:
            # a fork of this process needs its own, and the limit may have changed
            if self._process is None or self._state != (os.getpid(), frame_memory()):
                self._end()
                self._process, self._state = _started(), (os.getpid(), frame_memory())
            process = self._process
            watch = Timer(MOST_S, process.kill)
            try:
                assert process.stdin is not None and process.stdout is not None
                watch.start()
                pickle.dump((function, values), process.stdin, pickle.HIGHEST_PROTOCOL)
                process.stdin.flush()
                answer = _received(process.stdout)
            except (OSError, EOFError, pickle.UnpicklingError) as error:
                self._end()
                raise FenceError("is damaged: its decoder crashed, or did not end") from error
            except BaseException:
                # interrupted: the answer is still to come
                self._end()
                raise
            finally:
                watch.cancel()
        if isinstance(answer, Exception):
            raise answer
        return answer

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None and self._state[0] == os.getpid():
            process.kill()
            process.wait()
            for stream in (process.stdin, process.stdout):
                with suppress(OSError):
                    if stream is not None:
                        stream.close()


fenced = _Fence()


def _received(stream: IO[bytes]) -> Any:
    packed, lengths = pickle.load(stream)
    arrays = [bytearray(length) for length in lengths]
    for array in arrays:
        if stream.readinto(array) < len(array):  # type: ignore[attr-defined]
            raise EOFError
    return pickle.loads(packed, buffers=arrays)


def _started() -> subprocess.Popen[bytes]:
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", PROGRAM],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=os.environ | SETTINGS,
        # an interrupt at the terminal is for this process, which then ends the other
        process_group=0 if os.name != "nt" else None,
    )
    assert process.stdin is not None and process.stdout is not None
    if sys.platform == "linux":
        import fcntl

        # a third of the time for large arrays; refused where a user has many pipes
        with suppress(OSError):
            for stream in (process.stdin, process.stdout):
                fcntl.fcntl(stream, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    pickle.dump(sys.path, process.stdin)
    return process


def serve() -> None:
    if sys.platform != "win32":
        import resource

        most_bytes, (_, hard) = LIBRARIES_BYTES + 2 * frame_memory(), resource.getrlimit(resource.RLIMIT_AS)
        # a lower one may hold already; macOS may refuse any
        if hard == resource.RLIM_INFINITY or most_bytes < hard:
            with suppress(ValueError):
                resource.setrlimit(resource.RLIMIT_AS, (most_bytes, most_bytes))
    out = os.fdopen(os.dup(1), "wb")
    # what libraries print must not be taken for an answer
    os.dup2(2, 1)
    while True:
        try:
            # without names, so that nothing of a file stays
            out.writelines(_answer(*pickle.load(sys.stdin.buffer)))
        except EOFError:
            return
        out.flush()


def _answer(function: str, values: tuple[Any, ...]) -> list[bytes | memoryview]:
    """Returns the parts of what `_received` reads: a function's result or error, and the arrays in it as they are."""
    module, _, name = function.partition(":")
    try:
        result: Any = getattr(import_module(module), name)(*values)
        return _parts(result)
    except MemoryError:
        result = FenceError(f"is too large: decoding it takes more memory than a frame may ({VARIABLE} sets more)")
    except ValueError as error:
        result = error
    # for damaged files, libraries raise any exception; lazrs a PanicException, which is not an Exception
    except BaseException as error:
        result = FenceError(f"cannot be decoded ({type(error).__name__}: {str(error)[:100]})")
    return _parts(result)


def _parts(result: Any) -> list[bytes | memoryview]:
    buffers: list[pickle.PickleBuffer] = []
    packed = pickle.dumps(result, pickle.HIGHEST_PROTOCOL, buffer_callback=buffers.append)
    arrays = [buffer.raw() for buffer in buffers]
    lengths = [array.nbytes for array in arrays]
    if len(packed) + sum(lengths) > frame_memory():
        raise MemoryError
    return [pickle.dumps((packed, lengths)), *arrays]
