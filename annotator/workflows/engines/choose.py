"""The engine that was asked for, with as many workers as the machine or cluster is good for."""

from __future__ import annotations

from enum import StrEnum

from annotator.detection.backends.cores import usable_cores
from annotator.types.errors import ConfigError
from annotator.workflows.engines.engine import Engine
from annotator.workflows.engines.inline import InlineEngine
from annotator.workflows.engines.local import local_engine
from annotator.workflows.engines.machine import cuda_devices
from annotator.workflows.engines.sources import DetectorSource
from annotator.workflows.engines.storage import Storage

# Fewer frames are done before workers have loaded what they need.
FEWEST_FRAMES = 16


class EngineName(StrEnum):
    """Where frames are worked on. AUTO: in worker processes where the machine has several cores (or a GPU) and there
    is enough to do, else in this process."""

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
    """An engine; nothing is loaded before it is started, but Ray is connected to.

    Args:
        source: of the detectors.
        frames: at most so many are to be done.
        workers: None: one a GPU, or else one a core (of the cluster's, on a cluster).
        threads: of the processor for each worker; None: its share of the machine's cores, on a cluster one.
        address: of a Ray cluster; None: one on this machine.
        storage: where workers read recordings.

    Raises:
        ConfigError: numbers of no use, or options that do not go together.
        MissingExtraError, WorkerError: Ray is not installed, or the cluster cannot be reached.
    """
    storage = storage or Storage()
    for option, value in (("workers", workers), ("threads", threads)):
        if value is not None and value < 1:
            raise ConfigError(f"--{option} {value} is of no use; give 1 or more")
    if address is not None and name is not EngineName.RAY:
        raise ConfigError("--address names a Ray cluster; add --engine ray, or leave it away")
    gpus, cores = cuda_devices(), usable_cores()
    if name is EngineName.AUTO:
        is_worth_it = workers != 1 and (workers is not None or cores > 1 or bool(gpus))
        name = EngineName.LOCAL if is_worth_it and frames >= FEWEST_FRAMES else EngineName.INLINE
    elif name is EngineName.INLINE and workers not in (None, 1):
        raise ConfigError("--engine inline has no workers; leave --workers away, or take --engine local")
    match name:
        case EngineName.LOCAL:
            workers = workers or len(gpus) or cores
            return local_engine(source, workers, threads or max(cores // workers, 1), storage, gpus)
        case EngineName.RAY:
            from annotator.workflows.engines.ray_engine import RayEngine

            return RayEngine(source, workers, threads or 1, storage, address)
        case _:
            return InlineEngine(source, threads, storage)
