"""Chooses the backend that runs a detector."""

from __future__ import annotations

import ctypes
import logging
import sys
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

from annotator.detection.backends.export import Export, export, export_key, find_export, keep_export, one_at_a_time
from annotator.detection.backends.openvino_network import OpenVinoNetwork
from annotator.detection.backends.torch_network import TorchNetwork
from annotator.detection.config import Backend, DetectorConfig
from annotator.types.errors import AnnotatorError, ConfigError, DetectionError

LOG = logging.getLogger("annotator.detectors")

Network = OpenVinoNetwork | TorchNetwork
"""A trained network, ready to run; thread-safe. `predict` takes one batch per canvas size, all in one call, so that
idle cores can start on the next size; it raises a DetectionError if the backend fails, as for want of memory."""


def open_network(weights: Path, weights_sha256: str, config: DetectorConfig) -> Network:
    """Opens a weights file on the configured backend; for "auto" and "fastest", on the fastest usable one.

    The order is: torch with a CUDA device, OpenVINO where it is installed, torch. With "fastest", OpenVINO
    computes in half precision if the CPU supports it. With "auto" and "fastest", a backend that cannot run this
    network is skipped, and the reason is logged.
    """
    first, *others = _choices(config)
    try:
        network = _open(weights, weights_sha256, config, first)
    except AnnotatorError as error:
        if not others or find_spec("torch") is None:
            raise
        LOG.warning("%s: cannot run on %s: %s", weights, first, error)
        network = _open(weights, weights_sha256, config, others[0])
    LOG.info("%s: runs on %s", weights, network.backend)
    return network


def _open(weights: Path, weights_sha256: str, config: DetectorConfig, backend: Backend) -> Network:
    if backend in ("openvino", "openvino-bf16"):
        from annotator.detection.backends.openvino_network import computes_bfloat16

        if backend == "openvino-bf16" and not computes_bfloat16():
            if config.backend == backend:
                raise ConfigError("this processor has no instructions for bfloat16; use the backend openvino")
            backend = "openvino"
        exported = _exported(weights, weights_sha256)
        return OpenVinoNetwork(exported.facts, exported.parts, config.threads, bfloat16=backend == "openvino-bf16")
    from annotator.detection.ultralytics_api import pick_device

    return TorchNetwork(weights, pick_device(config.device), config.threads)


def _exported(weights: Path, weights_sha256: str) -> Export:
    key = export_key(weights_sha256)
    cached = find_export(key)
    if cached is not None:
        return cached
    with one_at_a_time():
        cached = find_export(key)  # another process may have finished it meanwhile
        if cached is None:
            LOG.info("%s: converting for OpenVINO; the result is reused", weights)
            cached = export(weights)
            keep_export(key, cached)
    return cached


def _choices(config: DetectorConfig) -> tuple[Backend, ...]:
    """Backends to try, fastest first. Errors of the last one are raised, not logged.

    With "fastest", openvino-bf16 is listed even if the CPU does not support bfloat16; it is then replaced by openvino.
    """
    other_device = config.device not in ("auto", "cpu")
    if config.backend not in ("auto", "fastest"):
        if other_device and config.backend != "torch":
            raise ConfigError(f"{config.backend} runs on the processor, not on {config.device}; use the backend torch")
        return (config.backend,)
    if other_device or (config.device == "auto" and has_cuda()) or find_spec("openvino") is None:
        return ("torch",)
    return ("openvino-bf16" if config.backend == "fastest" else "openvino", "torch")


def chosen(config: DetectorConfig) -> tuple[Backend, str]:
    """The backend that `open_network` would choose for a network that all backends support, and the reason.

    Loads the packages of each candidate until one loads without an error.
    """
    from annotator.detection.backends.openvino_network import computes_bfloat16, openvino
    from annotator.detection.ultralytics_api import api

    reasons = ["there is a CUDA device" if has_cuda() else "no CUDA device that detectors can use"]
    for backend in _choices(config):
        try:
            (api if backend == "torch" else openvino)()
            usable = "openvino" if backend == "openvino-bf16" and not computes_bfloat16() else backend
            return usable, "; ".join(reasons)
        except AnnotatorError as error:
            reasons.append(f"{backend} cannot be used: {error}")
    raise DetectionError("; ".join(reasons))


@lru_cache(maxsize=1)
def has_cuda() -> bool:
    """Whether torch can use an NVIDIA device.

    Torch takes seconds to load, so it is loaded only if the NVIDIA driver lists a device.
    """
    if not driver_devices():
        return False
    from annotator.detection.ultralytics_api import api

    try:
        return bool(api().torch.cuda.is_available())
    except DetectionError:
        return False


def driver_devices() -> int:
    """Number of devices that the NVIDIA driver shows to this process (CUDA driver API: cuInit, cuDeviceGetCount)."""
    try:
        driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return 0
    count = ctypes.c_int(0)
    if driver.cuInit(0) or driver.cuDeviceGetCount(ctypes.byref(count)):
        return 0
    return count.value
