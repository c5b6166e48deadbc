"""Which backend runs a detector."""

from __future__ import annotations

import ctypes
import logging
import platform
import sys
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

from annotator.detection.backends.export_cache import Export, export_key, find_export, keep_export, one_at_a_time
from annotator.detection.backends.network import ExportKind, Network
from annotator.detection.config import Backend, DetectorConfig
from annotator.types.errors import AnnotatorError, ConfigError, DetectionError, MissingExtraError

LOG = logging.getLogger("annotator.detectors")


def open_network(weights: Path, weights_sha256: str, config: DetectorConfig) -> Network:
    """The network of a weights file on the backend that is asked for; with auto on the fastest that can be used.

    That is torch where there is a CUDA device, else OpenVINO on x86 processors, else ONNX Runtime, else torch; with
    fastest, OpenVINO computes in half precision where the processor has instructions for it. With both, one that cannot
    run this network is passed over, and the log says why.

    Raises:
        ConfigError: the backend cannot use the device.
        DetectionError: unusable weights or device; or the backend that was asked for cannot run them.
        MissingExtraError: it is not installed.
    """
    choices = _choices(config)
    for backend in choices[:-1]:
        try:
            return _opened(weights, weights_sha256, config, backend)
        except AnnotatorError as error:
            if find_spec("torch") is None:
                raise
            LOG.warning("%s: not run on %s: %s", weights, backend, error)
    return _opened(weights, weights_sha256, config, choices[-1])


def _opened(weights: Path, weights_sha256: str, config: DetectorConfig, backend: Backend) -> Network:
    network = _open(weights, weights_sha256, config, backend)
    LOG.info("%s: runs on %s", weights, network.backend)
    return network


def _open(weights: Path, weights_sha256: str, config: DetectorConfig, backend: Backend) -> Network:
    # Each is imported where it is used: none of them loads the packages of another.
    if backend in ("openvino", "openvino-bf16"):
        from annotator.detection.backends.openvino_api import computes_bfloat16
        from annotator.detection.backends.openvino_network import OpenVinoNetwork

        if backend == "openvino-bf16" and not computes_bfloat16():
            if config.backend == backend:
                raise ConfigError("this processor has no instructions for bfloat16; use the backend openvino")
            backend = "openvino"
        export = _exported(weights, weights_sha256, "openvino")
        return OpenVinoNetwork(export.facts, export.parts, config.threads, bfloat16=backend == "openvino-bf16")
    if backend == "onnxruntime":
        from annotator.detection.backends.onnx_network import OnnxNetwork

        if find_spec("onnxruntime") is None:  # told before the work of an export
            raise MissingExtraError("onnxruntime", "onnx")
        export = _exported(weights, weights_sha256, backend)
        return OnnxNetwork(export.facts, export.parts, config.threads)
    from annotator.detection.backends.torch_network import TorchNetwork
    from annotator.detection.ultralytics_api import pick_device

    return TorchNetwork(weights, pick_device(config.device), config.threads)


def _exported(weights: Path, weights_sha256: str, kind: ExportKind) -> Export:
    key = export_key(kind, weights_sha256)
    found = find_export(weights, kind, key)
    if found is not None:
        return found
    with one_at_a_time():
        found = find_export(weights, kind, key)  # by now somebody else's
        if found is None:
            from annotator.detection.backends.export import export

            LOG.info("%s: converted for %s, once", weights, kind)
            facts, parts = export(weights, kind)
            found = Export(facts, parts)
            keep_export(weights, kind, key, found)
    return found


def _choices(config: DetectorConfig) -> tuple[Backend, ...]:
    """Backends to try, fastest first; the last one may fail.

    With fastest, openvino-bf16 stands for openvino where the processor has no bfloat16.
    """
    other_device = config.device not in ("auto", "cpu")
    if config.backend not in ("auto", "fastest"):
        if other_device and config.backend != "torch":
            raise ConfigError(f"{config.backend} runs on the processor, not on {config.device}; use the backend torch")
        return (config.backend,)
    if other_device or (config.device == "auto" and has_cuda()):
        return ("torch",)
    faster: list[Backend] = []
    if platform.machine().lower() in ("x86_64", "amd64") and find_spec("openvino") is not None:
        faster.append("openvino-bf16" if config.backend == "fastest" else "openvino")
    if find_spec("onnxruntime") is not None and find_spec("onnx") is not None:
        faster.append("onnxruntime")
    return (*faster, "torch")


@lru_cache(maxsize=1)
def has_cuda() -> bool:
    """Whether torch can use an NVIDIA device. Torch, which takes seconds to load, is asked only where the driver's own
    library knows of one."""
    if not _driver_devices():
        return False
    from annotator.detection.ultralytics_api import api

    try:
        return bool(api().torch.cuda.is_available())
    except DetectionError:
        return False


def _driver_devices() -> int:
    """How many devices the NVIDIA driver shows to this process (CUDA driver API: cuInit, cuDeviceGetCount)."""
    try:
        driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return 0
    count = ctypes.c_int(0)
    if driver.cuInit(0) or driver.cuDeviceGetCount(ctypes.byref(count)):
        return 0
    return count.value
