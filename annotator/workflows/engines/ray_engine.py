"""Workers as Ray actors: on a cluster, or on one that is started here, on this machine alone, and ends with us.

Ray looks after machines, processes and the way of the values; who does what, and what happens when an actor is lost, is
decided where it is for local workers (`pool.py`). So Ray itself retries nothing.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from annotator.detection.backends.cores import usable_cores
from annotator.types.errors import ConfigError, MissingExtraError, WorkerError
from annotator.workflows.engines.events import Died, Done, Ready, Refused, Tell
from annotator.workflows.engines.local import environment
from annotator.workflows.engines.machine import cuda_devices
from annotator.workflows.engines.messages import Fault, fault_of
from annotator.workflows.engines.pool import HELD, WorkerPool
from annotator.workflows.engines.runner import TaskRunner
from annotator.workflows.engines.sources import DetectorSource, PackedDetectors, TrainedDetectors
from annotator.workflows.engines.storage import Storage
from annotator.workflows.engines.tasks import Answer, Identity, Task

# Read by Ray as it is imported: nothing is reported to anybody.
SWITCHES = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
# A cluster of our own listens on 127.0.0.1 alone: that is what this does, though its name speaks of other systems.
LOCAL_SWITCHES = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
# Of a cluster of our own: weights and answers on their way.
OBJECT_STORE_BYTES = 200 * 2**20
# How Ray speaks of an actor that could not be made, in contrast to one that was lost.
CREATION = "error raised in its creation task"


class RayActor:
    """What runs in an actor: a pair of detectors, and two threads, so that one reads while the other one proposes."""

    def __init__(self, source: DetectorSource, threads: int, storage: Storage) -> None:
        """
        Args:
            source, threads, storage: as of a local worker. (Ray gives what it was handed as a reference by value.)
        """
        import cv2

        cv2.setNumThreads(threads)
        self._fault: Fault | None = None
        try:
            self._runner = TaskRunner(source.load(threads), storage)
        except Exception as error:
            self._fault = fault_of(error)

    def identity(self) -> Identity | Fault:
        """What decides its results, or why it cannot begin."""
        return self._fault or self._runner.identity

    def do(self, task: Task) -> Answer:
        """As `TaskRunner.do`."""
        return self._runner.do(task)


class RayWorker:
    """An actor, as the pool sees it."""

    def __init__(self, number: int, tell: Tell, make: Callable[[], Any]) -> None:
        """
        Args:
            number: in its events.
            tell: takes them, from Ray's threads.
            make: makes the actor.
        """
        self._number, self._tell = number, tell
        self._actor = make()
        self._is_over = False
        self._actor.identity.remote().future().add_done_callback(self._begun)

    def send(self, task: Task) -> None:
        """Gives it a task; that it was lost before is told once."""
        self._actor.do.remote(task).future().add_done_callback(self._answered)

    def end(self) -> None:
        """Kills the actor."""
        self._is_over = True
        import ray

        ray.kill(self._actor)

    def _begun(self, future: Any) -> None:
        if future.exception() is not None:
            self._lost(future.exception())
            return
        said = future.result()
        if isinstance(said, Fault):
            self._tell(Refused(self._number, said.reason, said.is_fault))
        else:
            self._tell(Ready(self._number, said))

    def _answered(self, future: Any) -> None:
        if future.exception() is not None:
            self._lost(future.exception())
        else:
            self._tell(Done(self._number, future.result()))

    def _lost(self, error: BaseException) -> None:
        if self._is_over:  # every call that was on its way fails
            return
        self._is_over = True
        if isinstance(error, _losses()) and CREATION not in str(error):
            self._tell(Died(self._number, "lost: " + _last_words(str(error))))
        else:
            # no actor would do better: a class that is not known there, a package that is not installed
            self._tell(Refused(self._number, str(error), True))


def _losses() -> tuple[type[Exception], ...]:
    """What Ray raises where an actor, its machine or its answer is lost; they have no class of their own in common."""
    from ray import exceptions

    return (
        exceptions.RayActorError,
        exceptions.OutOfMemoryError,  # Ray has killed it before the system would
        exceptions.NodeDiedError,
        exceptions.WorkerCrashedError,
        exceptions.ObjectLostError,  # the machine went after the work was done
    )


def _last_words(reason: str) -> str:
    """The line of Ray's report that says why."""
    lines = [line.strip() for line in reason.splitlines() if line.strip()]
    return next((line for line in lines if line.startswith("The actor is dead because")), lines[0] if lines else "?")


class RayEngine(WorkerPool):
    """A pool of actors, and the connection to their cluster."""

    def __init__(
        self, source: DetectorSource, workers: int | None, threads: int, storage: Storage, address: str | None = None
    ) -> None:
        """
        Args:
            source: of each actor's detectors; trained ones travel with their weights, once to each machine.
            workers: how many actors; None: one a GPU of the cluster, or else as many as its cores are enough for.
            threads: of the processor for each, reserved with Ray.
            storage: where actors read recordings.
            address: of a cluster ("auto", or HOST:PORT of its head); None: one of our own.

        Raises:
            ConfigError: the cluster is too small for so many workers.
            MissingExtraError: Ray is not installed.
            WorkerError: the cluster cannot be reached or started.
        """
        self._ray = _connected(address, None if workers is None else workers * threads)
        try:
            offer = self._ray.cluster_resources()
            cores, gpus = int(offer.get("CPU", 0)), int(offer.get("GPU", 0))
            most = most_workers(self._ray.nodes(), threads)
            if most < (workers or 1):
                raise ConfigError(
                    f"the cluster has {cores} cores and {gpus} GPUs, enough for {most} workers of {threads} threads; "
                    "take fewer --workers or --threads, or start more machines first"
                )
            super().__init__(self._make_worker, workers or most)
            packed = PackedDetectors.of(source) if isinstance(source, TrainedDetectors) else source
            kept = self._ray.put(packed)
        except BaseException:
            self._ray.shutdown()
            raise
        remote = self._ray.remote(RayActor).options(
            num_cpus=threads,
            num_gpus=1 if gpus else 0,
            max_concurrency=HELD,
            max_restarts=0,
            max_task_retries=0,
            runtime_env={"env_vars": {**SWITCHES, **environment(threads)}},
        )
        self._make_actor: Callable[[], Any] = lambda: remote.remote(kept, threads, storage)

    def _make_worker(self, number: int, tell: Tell) -> RayWorker:
        return RayWorker(number, tell, self._make_actor)

    def close(self) -> None:
        """Ends the actors, and a cluster of our own."""
        super().close()
        self._ray.shutdown()


def most_workers(nodes: Sequence[Mapping[str, Any]], threads: int) -> int:
    """How many workers fit on a cluster. One that fits on no machine would be waited for without end.

    Args:
        nodes: its machines, as `ray.nodes()` gives them.
        threads: cores that a worker needs, all on one machine; and a GPU, where the cluster has any.
    """
    offers = [node["Resources"] for node in nodes if node["Alive"]]
    needs_gpu = any(offer.get("GPU", 0) >= 1 for offer in offers)
    fit = [(int(offer.get("CPU", 0)) // threads, int(offer.get("GPU", 0))) for offer in offers]
    return sum(min(cores, gpus) if needs_gpu else cores for cores, gpus in fit)


def _connected(address: str | None, cores: int | None) -> Any:
    """The module `ray`, connected to a cluster, or to one of our own with so many cores (None: the machine's)."""
    os.environ.update(SWITCHES if address else SWITCHES | LOCAL_SWITCHES)
    try:
        import ray
    except ImportError as error:
        raise MissingExtraError("ray", "ray") from error
    own: dict[str, Any] = {
        "num_cpus": cores or usable_cores(),
        "num_gpus": len(cuda_devices()),
        "include_dashboard": False,
        "object_store_memory": OBJECT_STORE_BYTES,
        "_node_ip_address": "127.0.0.1",
    }
    try:
        # "local" never takes a cluster that RAY_ADDRESS or another process of the machine offers
        ray.init(address=address or "local", log_to_driver=False, logging_level="error", **({} if address else own))
    except Exception as error:  # ConnectionError, RuntimeError, ValueError and kinds of grpc's
        where = f"the cluster at {address}" if address else "a cluster on this machine"
        first = str(error).strip().splitlines()[:1]
        raise WorkerError(
            f"Ray cannot reach {where}: {''.join(first) or type(error).__name__}; check it with `ray status`, "
            "or take --engine local"
        ) from error
    return ray
