"""Worker processes on this machine, each with its own detectors and its share of the cores."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
from contextlib import suppress

from annotator.workflows.engines.events import Died, Done, Ready, Refused, Tell
from annotator.workflows.engines.messages import Fault, Start
from annotator.workflows.engines.pool import WorkerPool
from annotator.workflows.engines.sources import DetectorSource
from annotator.workflows.engines.storage import Storage
from annotator.workflows.engines.tasks import Answer, Identity, Task

# Modules are looked for where the driver looks, and nowhere else: -P leaves the current folder away, in which any file
# may lie that has the name of one.
PROGRAM = (
    "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); "
    "from annotator.workflows.engines.worker import main; sys.exit(main())"
)
# Read by the libraries as they are loaded; a worker's threads would fight with the next worker's for the cores.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class LocalWorker:
    """A worker process. It ends by itself when this process does, however that ends."""

    def __init__(self, number: int, tell: Tell, start: Start, gpu: str | None = None) -> None:
        """
        Args:
            number: in its events.
            tell: takes them.
            start: what it needs to begin.
            gpu: the one that it may see, as `CUDA_VISIBLE_DEVICES` names it; None: all.
        """
        self.number, self._tell = number, tell
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **environment(start.threads), **({} if gpu is None else {"CUDA_VISIBLE_DEVICES": gpu})},
            # an interrupt at the terminal is for the driver, which ends its workers itself
            process_group=0 if os.name != "nt" else None,
        )
        self._write(sys.path)
        self._write(start)
        threading.Thread(target=self._listen, name=f"worker {number}", daemon=True).start()

    @property
    def pid(self) -> int:
        """The process's id."""
        return self._process.pid

    def send(self, task: Task) -> None:
        """Gives it a task; nothing happens where it has died."""
        self._write(task)

    def end(self) -> None:
        """Kills it: nothing of it is worth waiting for."""
        with suppress(ProcessLookupError):
            self._process.kill()
        self._process.wait()

    def _write(self, value: object) -> None:
        assert self._process.stdin is not None
        # that it has died is told by the thread that listens
        with suppress(BrokenPipeError, ValueError):
            pickle.dump(value, self._process.stdin)
            self._process.stdin.flush()

    def _listen(self) -> None:
        assert self._process.stdout is not None and self._process.stdin is not None
        with self._process.stdout as stream:
            while True:
                try:
                    said = pickle.load(stream)
                except (EOFError, pickle.UnpicklingError):  # also in the middle of an answer
                    break
                match said:
                    case Identity():
                        self._tell(Ready(self.number, said))
                    case Answer():
                        self._tell(Done(self.number, said))
                    case Fault():
                        self._tell(Refused(self.number, said.reason, said.is_fault))
        code = self._process.wait()
        with suppress(BrokenPipeError):
            self._process.stdin.close()
        self._tell(Died(self.number, ended(code)))


def ended(code: int) -> str:
    """An exit code in words."""
    if code == -signal.SIGKILL:
        return "killed, perhaps for want of memory"
    return f"by signal {-code}" if code < 0 else f"with exit code {code}"


def environment(threads: int | None) -> dict[str, str]:
    """The variables that hold a process to so many threads."""
    return {} if threads is None else dict.fromkeys(THREAD_VARIABLES, str(threads))


def local_engine(
    source: DetectorSource, workers: int, threads: int | None, storage: Storage, gpus: tuple[str, ...] = ()
) -> WorkerPool:
    """An engine of worker processes on this machine.

    Args:
        source: of each worker's detectors.
        workers: how many.
        threads: of the processor, for each worker; None: all cores.
        storage: where recordings are read.
        gpus: names of the machine's GPUs; workers take turns.
    """
    start = Start(source, threads, storage)
    return WorkerPool(
        lambda number, tell: LocalWorker(number, tell, start, gpus[number % len(gpus)] if gpus else None), workers
    )
