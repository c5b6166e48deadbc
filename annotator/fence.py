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
from threading import Lock
from typing import Any

from annotator.child import Child, parent
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


class FenceError(ValueError):
    """A decoder crashed, took too long or too much memory, or failed; the message says which."""


class _Fence:
    def __init__(self) -> None:
        self._child: Child | None = None
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
            if self._child is None or self._state != (os.getpid(), frame_memory()):
                self._end()
                self._child, self._state = (
                    Child(f"{__name__}:serve", SETTINGS, subprocess.DEVNULL),
                    (os.getpid(), frame_memory()),
                )
            child = self._child
            try:
                with child.within(MOST_S):
                    child.send((function, values))
                    answer = child.receive()
            except EOFError as error:
                self._end()
                raise FenceError("is damaged: its decoder crashed, or did not end") from error
            except BaseException:
                # interrupted: the answer is still to come
                self._end()
                raise
        if isinstance(answer, Exception):
            raise answer
        return answer

    def _end(self) -> None:
        child, self._child = self._child, None
        if child is not None and self._state[0] == os.getpid():
            child.close()


fenced = _Fence()


def serve() -> None:
    if sys.platform != "win32":
        import resource

        most_bytes, (_, hard) = LIBRARIES_BYTES + 2 * frame_memory(), resource.getrlimit(resource.RLIMIT_AS)
        # a lower one may hold already; macOS may refuse any
        if hard == resource.RLIM_INFINITY or most_bytes < hard:
            with suppress(ValueError):
                resource.setrlimit(resource.RLIMIT_AS, (most_bytes, most_bytes))
    pipe = parent()
    while True:
        try:
            # without names, so that nothing of a file stays
            pipe.write(_answer(*pipe.receive()))
        except EOFError:
            return


def _answer(function: str, values: tuple[Any, ...]) -> bytes:
    """Returns a function's result or error, pickled."""
    module, _, name = function.partition(":")
    try:
        packed = pickle.dumps(getattr(import_module(module), name)(*values), pickle.HIGHEST_PROTOCOL)
        if len(packed) <= frame_memory():
            return packed
        raise MemoryError
    except MemoryError:
        said: ValueError = FenceError(
            f"is too large: decoding it takes more memory than a frame may ({VARIABLE} sets more)"
        )
    except ValueError as error:
        said = error
    # for damaged files, libraries raise any exception; lazrs a PanicException, which is not an Exception
    except BaseException as error:
        said = FenceError(f"cannot be decoded ({type(error).__name__}: {str(error)[:100]})")
    return pickle.dumps(said)
