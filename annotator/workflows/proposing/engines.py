"""Engines that process the frames of a batch, by name; and the one of worker processes on this machine.

Each worker has its own detectors and share of the cores, and never accesses the project's database. It gets a tuple
(source of its detectors, threads, storage), then tasks; it ends when the driver closes the pipe, or dies. It sends an
`Identity`, then answers; or a `Fault` and nothing else.
"""

from __future__ import annotations

import os
import queue
import signal
import sys
import threading
import traceback
from contextlib import suppress
from enum import StrEnum

from annotator.child import Child, Pipe, parent
from annotator.detection.backends.choose import driver_devices, has_cuda
from annotator.detection.backends.network import usable_cores
from annotator.types.errors import ConfigError
from annotator.workflows.proposing.pool import Died, Report, WorkerPool, fault_of
from annotator.workflows.proposing.runner import Engine, InlineEngine, TaskRunner
from annotator.workflows.proposing.tasks import DetectorSource, Storage, Task

# One thread proposes while the other one reads frames.
THREADS = 2


def main() -> None:
    """Runs tasks until the driver closes the pipe or dies."""
    driver = parent()
    try:
        runner = make_runner(*driver.receive())
        driver.send(runner.identity)
    except Exception as error:
        driver.send(fault_of(error))
        return
    tasks: queue.SimpleQueue[Task] = queue.SimpleQueue()
    for _ in range(THREADS):
        threading.Thread(target=_work, args=(runner, tasks, driver), daemon=True).start()
    try:
        while True:
            tasks.put(driver.receive())
    except EOFError:
        # unfinished tasks are not needed
        os._exit(0)


def make_runner(source: DetectorSource, threads: int | None, storage: Storage) -> TaskRunner:
    """Loads a worker's detectors, each with a number of processor threads (None = all cores)."""
    import cv2

    if threads is not None:
        # OpenCV has no environment variable for it
        cv2.setNumThreads(threads)
    return TaskRunner(source.load(threads), storage)


def _work(runner: TaskRunner, tasks: queue.SimpleQueue[Task], driver: Pipe) -> None:
    try:
        while True:
            driver.send(runner.do(tasks.get()))
    except BaseException:
        # TaskRunner.do returns every error as an answer, so this process is broken: end it
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)


# Read by the libraries when they are loaded. Without them, each worker would use all cores.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class LocalWorker:
    """A worker process. It ends by itself when this process ends, even by a crash."""

    def __init__(
        self,
        number: int,
        report: Report,
        start: tuple[DetectorSource, int | None, Storage],
        gpu: str | None = None,
    ) -> None:
        self.number, self._report = number, report
        devices = {} if gpu is None else {"CUDA_VISIBLE_DEVICES": gpu}
        self._child = Child(f"{__name__}:main", environment(start[1]) | devices)
        self._child.send(start)
        threading.Thread(target=self._listen, name=f"worker {number}", daemon=True).start()

    def send(self, task: Task) -> None:
        """Sends a task; does nothing if the worker is dead."""
        self._child.send(task)

    def end(self) -> None:
        self._child.process.kill()
        self._child.process.wait()

    def _listen(self) -> None:
        with suppress(EOFError):
            while True:
                self._report(self.number, self._child.receive())
        code = self._child.process.wait()
        self._child.close()
        self._report(self.number, Died(exit_reason(code)))


def exit_reason(code: int) -> str:
    if code == -signal.SIGKILL:
        return "killed, possibly out of memory"
    return f"by signal {-code}" if code < 0 else f"with exit code {code}"


def environment(threads: int | None) -> dict[str, str]:
    """Returns the environment variables that limit a process to a number of threads; None = no limit."""
    return {} if threads is None else dict.fromkeys(THREAD_VARIABLES, str(threads))


def local_engine(
    source: DetectorSource, workers: int, threads: int | None, storage: Storage, gpus: tuple[str, ...] = ()
) -> WorkerPool:
    """Makes an engine of worker processes on this machine."""
    start = source, threads, storage
    return WorkerPool(
        lambda number, report: LocalWorker(number, report, start, gpus[number % len(gpus)] if gpus else None), workers
    )


def cuda_devices() -> tuple[str, ...]:
    """Returns the GPUs that detectors can use, as named in `CUDA_VISIBLE_DEVICES`."""
    count, visible = driver_devices() if has_cuda() else 0, os.environ.get("CUDA_VISIBLE_DEVICES")
    names = map(str, range(count)) if visible is None else (name.strip() for name in visible.split(","))
    return tuple(names)[:count]


# With fewer frames, this process finishes before workers would have loaded the detectors.
MIN_FRAMES = 16


class EngineName(StrEnum):
    """The engines. AUTO: worker processes if the machine has several cores or a GPU and there are enough frames, else
    this process."""

    AUTO = "auto"
    INLINE = "inline"
    LOCAL = "local"
    RAY = "ray"


def make_engine(
    name: EngineName,
    source: DetectorSource,
    *,
    frames: int,
    workers: int | None = None,
    threads: int | None = None,
    address: str | None = None,
    storage: Storage | None = None,
) -> Engine:
    """Makes an engine. Detectors are loaded when it is started; a Ray cluster is connected now.

    Args:
        workers: number of workers; None = one per GPU, or one per core without GPUs (of the cluster, with Ray).
        threads: processor threads of each worker; None = its share of the machine's cores (Ray: one thread).
        address: of a Ray cluster; None = one on this machine.
    """
    storage = storage or Storage()
    for option, value in (("workers", workers), ("threads", threads)):
        if value is not None and value < 1:
            raise ConfigError(f"--{option} {value} is too small; give 1 or more")
    if address is not None and name is not EngineName.RAY:
        raise ConfigError("--address names a Ray cluster; add --engine ray, or omit it")
    gpus, cores = cuda_devices(), usable_cores()
    if name is EngineName.AUTO:
        use_workers = workers != 1 and (workers is not None or cores > 1 or bool(gpus))
        name = EngineName.LOCAL if use_workers and frames >= MIN_FRAMES else EngineName.INLINE
    elif name is EngineName.INLINE and workers not in (None, 1):
        raise ConfigError("--engine inline has no workers; omit --workers, or use --engine local")
    match name:
        case EngineName.LOCAL:
            workers = workers or len(gpus) or cores
            return local_engine(source, workers, threads or max(cores // workers, 1), storage, gpus)
        case EngineName.RAY:
            from annotator.workflows.proposing.ray_engine import RayEngine

            return RayEngine(source, workers, threads or 1, storage, address)
        case _:
            return InlineEngine(source, threads, storage)
