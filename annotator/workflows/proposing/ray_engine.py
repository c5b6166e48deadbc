"""The engine of Ray actors, on an existing cluster, or on one that is started on this machine and ends with the engine.

Ray manages machines, processes and the transfer of values. As for local workers, `pool.py` distributes tasks and
handles lost actors, so Ray's own retries are switched off.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from annotator.detection.backends.network import usable_cores
from annotator.types.errors import ConfigError, MissingExtraError, WorkerError
from annotator.types.messages import amount
from annotator.workflows.detectors import TrainedDetectors
from annotator.workflows.proposing.engines import cuda_devices, environment, make_runner
from annotator.workflows.proposing.pool import TASKS_PER_WORKER, Died, Fault, Report, WorkerPool, fault_of
from annotator.workflows.proposing.tasks import Answer, DetectorSource, Identity, PackedDetectors, Storage, Task

# Read by Ray when it is imported. The first one switches usage reports off; the second one lets actors without a GPU
# keep the machine's CUDA_VISIBLE_DEVICES.
SWITCHES = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
# Makes a cluster started here listen on 127.0.0.1 only; in spite of its name, it applies to Linux, too.
LOCAL_SWITCHES = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
# Object store of a cluster started here: weights and answers in transit.
OBJECT_STORE_BYTES = 200 * 2**20
# Ray's message for an actor that could not be created, in contrast to one that was lost.
CREATION = "error raised in its creation task"


class RayActor:
    """The actor: a task runner. Ray calls it from two threads, so that one reads while the other one proposes."""

    def __init__(self, source: DetectorSource, threads: int, storage: Storage) -> None:
        """As `make_runner`; Ray resolves references to values."""
        self._fault: Fault | None = None
        try:
            self._runner = make_runner(source, threads, storage)
        except Exception as error:
            self._fault = fault_of(error)

    def identity(self) -> Identity | Fault:
        """Returns the detectors' identity, or why the actor cannot start."""
        return self._fault or self._runner.identity

    def do(self, task: Task) -> Answer:
        return self._runner.do(task)


class RayWorker:
    """The pool's worker for an actor."""

    def __init__(self, number: int, report: Report, make: Callable[[], Any]) -> None:
        self._number, self._report = number, report
        self._actor = make()
        self._is_over = False
        self._actor.identity.remote().future().add_done_callback(self._told)

    def send(self, task: Task) -> None:
        """Sends a task; the loss of the actor is reported once."""
        self._actor.do.remote(task).future().add_done_callback(self._told)

    def end(self) -> None:
        self._is_over = True
        import ray

        ray.kill(self._actor)

    def _told(self, future: Any) -> None:
        if future.exception() is not None:
            self._lost(future.exception())
        else:
            self._report(self._number, future.result())

    def _lost(self, error: BaseException) -> None:
        if self._is_over:  # every pending call fails; the first has reported it
            return
        self._is_over = True
        from ray import exceptions

        # of the task itself, or for every actor; all others are of a lost actor, machine or answer
        own = (exceptions.RayTaskError, exceptions.RuntimeEnvSetupError)
        is_lost = isinstance(error, exceptions.RayError) and not isinstance(error, own)
        if is_lost and CREATION not in str(error):
            self._report(self._number, Died("lost: " + _cause_of_death(str(error))))
        else:
            # every actor would fail, e.g. for a missing package
            self._report(self._number, Fault(str(error), True))


def _cause_of_death(reason: str) -> str:
    """Returns the line of Ray's report that states why the actor died."""
    lines = [line.strip() for line in reason.splitlines() if line.strip()]
    return next((line for line in lines if line.startswith("The actor is dead because")), lines[0] if lines else "?")


class RayEngine(WorkerPool):
    """A pool of actors, and the connection to their cluster."""

    def __init__(
        self, source: DetectorSource, workers: int | None, threads: int, storage: Storage, address: str | None = None
    ) -> None:
        """
        Args:
            source: of each actor's detectors; the weights of trained ones are sent once to each machine.
            workers: number of actors; None = one per GPU of the cluster, or as many as fit its cores without GPUs.
            threads: processor threads of each, reserved with Ray.
            address: of a cluster ("auto", or HOST:PORT of its head); None = start one on this machine.
        """
        self._ray = _connect(address, None if workers is None else workers * threads)
        try:
            resources = self._ray.cluster_resources()
            cores, gpus = int(resources.get("CPU", 0)), int(resources.get("GPU", 0))
            limit = max_workers(self._ray.nodes(), threads)
            if limit < (workers or 1):
                raise ConfigError(
                    f"the cluster has {amount(cores, 'core')} and {amount(gpus, 'GPU')}, enough for "
                    f"{amount(limit, 'worker')} of {amount(threads, 'thread')}; "
                    "use fewer --workers or --threads, or add machines to the cluster"
                )
            super().__init__(lambda number, report: RayWorker(number, report, self._make_actor), workers or limit)
            packed = PackedDetectors.of(source) if isinstance(source, TrainedDetectors) else source
            packed_ref = self._ray.put(packed)
        except BaseException:
            self._ray.shutdown()
            raise
        remote = self._ray.remote(RayActor).options(
            num_cpus=threads,
            num_gpus=1 if gpus else 0,
            max_concurrency=TASKS_PER_WORKER,
            max_restarts=0,
            max_task_retries=0,
            runtime_env={"env_vars": {**SWITCHES, **environment(threads)}},
        )
        self._make_actor: Callable[[], Any] = lambda: remote.remote(packed_ref, threads, storage)

    def close(self) -> None:
        """Ends the actors, and a cluster started here."""
        super().close()
        self._ray.shutdown()


def max_workers(nodes: Sequence[Mapping[str, Any]], threads: int) -> int:
    """Returns how many workers fit on a cluster. Ray would wait forever for a worker that does not fit on any machine.

    Args:
        nodes: the machines, as returned by `ray.nodes()`.
        threads: cores per worker, all on one machine. If the cluster has GPUs, a worker also needs one.
    """
    offers = [node["Resources"] for node in nodes if node["Alive"]]
    needs_gpu = any(offer.get("GPU", 0) >= 1 for offer in offers)
    fit = [(int(offer.get("CPU", 0)) // threads, int(offer.get("GPU", 0))) for offer in offers]
    return sum(min(cores, gpus) if needs_gpu else cores for cores, gpus in fit)


def _connect(address: str | None, cores: int | None) -> Any:
    """Connects to a cluster, or starts one with a number of cores (None = the machine's); returns the module `ray`."""
    os.environ.update(SWITCHES if address else SWITCHES | LOCAL_SWITCHES)
    try:
        import ray
    except ImportError as error:
        raise MissingExtraError("ray", "ray") from error
    local_options: dict[str, Any] = {
        "num_cpus": cores or usable_cores(),
        "num_gpus": len(cuda_devices()),
        "include_dashboard": False,
        "object_store_memory": OBJECT_STORE_BYTES,
        "_node_ip_address": "127.0.0.1",
    }
    try:
        # "local" ignores RAY_ADDRESS and clusters of other processes on this machine
        options = {} if address else local_options
        ray.init(address=address or "local", log_to_driver=False, logging_level="error", **options)
    except Exception as error:  # ConnectionError, RuntimeError, ValueError and grpc's exceptions
        where = f"the cluster at {address}" if address else "a cluster on this machine"
        first_line = str(error).strip().splitlines()[:1]
        raise WorkerError(
            f"Ray cannot reach {where}: {''.join(first_line) or type(error).__name__}; check it with `ray status`, "
            "or use --engine local"
        ) from error
    return ray
