"""Makes an engine by name, with a number of workers that suits the machine or cluster."""

from __future__ import annotations

from enum import StrEnum

from annotator.detection.backends.network import usable_cores
from annotator.types.errors import ConfigError
from annotator.workflows.proposing.engines.engine import Engine
from annotator.workflows.proposing.engines.inline import InlineEngine
from annotator.workflows.proposing.engines.local import cuda_devices, local_engine
from annotator.workflows.proposing.engines.sources import DetectorSource
from annotator.workflows.proposing.engines.storage import Storage

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
        source: of the detectors.
        frames: maximum number of frames to do.
        workers: number of workers; None = one per GPU, or one per core without GPUs (of the cluster, with Ray).
        threads: processor threads of each worker; None = its share of the machine's cores (Ray: one thread).
        address: of a Ray cluster; None = one on this machine.
        storage: where workers read recordings.

    Raises:
        ConfigError: numbers below 1, or contradicting options.
        MissingExtraError, WorkerError: Ray is not installed, or the cluster cannot be reached.
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
            from annotator.workflows.proposing.engines.ray_engine import RayEngine

            return RayEngine(source, workers, threads or 1, storage, address)
        case _:
            return InlineEngine(source, threads, storage)
