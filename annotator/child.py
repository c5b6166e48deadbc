"""Processes of our own, on pipes of pickles: the fence, the workers of batches, and the checks of the machine.

A child runs one function with the module path of this process, and has ended by itself once this one has.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from threading import Lock, Timer
from types import MappingProxyType
from typing import IO, Any, cast

# -P excludes the current folder, whose files might shadow modules
PROGRAM = (
    "import pickle, sys; from importlib import import_module; sys.path[:] = pickle.load(sys.stdin.buffer); "
    "module, _, name = sys.argv[1].partition(':'); getattr(import_module(module), name)()"
)
PIPE_BYTES = 1 << 20
NO_VARIABLES: Mapping[str, str] = MappingProxyType({})


class Pipe:
    """One end of the pipes; several threads may send."""

    def __init__(self, reads: IO[bytes], writes: IO[bytes]) -> None:
        self._reads, self._writes, self._lock = reads, writes, Lock()

    def send(self, value: object) -> None:
        self.write(pickle.dumps(value, pickle.HIGHEST_PROTOCOL))

    def write(self, packed: bytes) -> None:
        """Sends a value that is pickled already."""
        with self._lock:
            self._writes.write(packed)
            self._writes.flush()

    def receive(self) -> Any:
        """Waits for a value; EOFError once the other end is gone, also in the middle of one."""
        try:
            return pickle.load(self._reads)
        except (OSError, pickle.UnpicklingError) as error:
            raise EOFError from error

    def close(self) -> None:
        for stream in (self._reads, self._writes):
            with suppress(OSError):
                stream.close()


def parent() -> Pipe:
    """In a child: its end of the pipes. What libraries print goes to standard error, and is taken for no message."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    # detached, since Python closes its standard input at the end, and aborts if a thread waits for it
    return Pipe(cast(Any, sys.stdin).detach(), out)


class Child(Pipe):
    """A process that runs the function `module:name`."""

    def __init__(
        self,
        function: str,
        variables: Mapping[str, str] = NO_VARIABLES,
        errors: IO[bytes] | int | None = None,
        *,
        in_session: bool = False,
    ) -> None:
        """
        Args:
            variables: of the environment, beside those of this process.
            errors: where standard error goes; None = where that of this process does.
            in_session: of its own, which has the processes that it starts.
        """
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-c", PROGRAM, function],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            env=os.environ | variables,
            # an interrupt at the terminal is for this process, which then ends the other
            process_group=0 if os.name != "nt" and not in_session else None,
            start_new_session=in_session,
        )
        reads, writes = self.process.stdout, self.process.stdin
        assert reads is not None and writes is not None
        super().__init__(reads, writes)
        if sys.platform == "linux":
            import fcntl

            # a third of the time for large arrays; refused where a user has many pipes
            with suppress(OSError):
                for stream in (reads, writes):
                    fcntl.fcntl(stream, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        self.send(sys.path)

    def write(self, packed: bytes) -> None:
        """As `Pipe.write`; does nothing if the process is dead, which `receive` tells."""
        with suppress(OSError, ValueError):
            super().write(packed)

    @contextmanager
    def within(self, seconds: float) -> Iterator[None]:
        """Kills the process if the block takes longer."""
        watch = Timer(seconds, self.process.kill)
        watch.start()
        try:
            yield
        finally:
            watch.cancel()

    def close(self) -> None:
        """Ends the process at once, and closes the pipes, which no other thread may use."""
        self.process.kill()
        self.process.wait()
        super().close()
