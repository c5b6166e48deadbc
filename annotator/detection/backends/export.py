"""Converts a trained network for OpenVINO, once: the results are kept in the user's cache.

The export needs torch; running it does not.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.etree import ElementTree

import numpy as np
from pydantic import ValidationError

from annotator.detection.backends.network import NetworkFacts
from annotator.detection.backends.openvino_network import openvino
from annotator.detection.backends.torch_network import raw_network
from annotator.detection.ultralytics_api import api, cache_dir, forget_oldest
from annotator.detection.weights import open_tensors
from annotator.files import NETWORK_BYTES, FolderLock, lock_folder, read_file, write_atomic
from annotator.types.errors import DetectionError

# Keeps parts of the detection head in single precision while OpenVINO computes the network in bfloat16.
#
# OpenVINO keeps the layers after the last convolutions in single precision, and also layers that are marked as
# precise. The changes made here reduce the error of box edges to a third and that of scores to two thirds, at almost
# no cost in time (docs/notebook.md).


LOG = logging.getLogger("annotator.detectors")

# Attribute of a layer's `rt_info` in OpenVINO's files.
PRECISE = {"name": "precise", "version": "0"}
# Activations and biases take the precision of the convolution before them. They cannot be marked themselves: all
# activations have the same name, since ultralytics uses one module for all of them.
CONVOLUTIONS = ("Convolution", "GroupConvolution")
# A layer's name begins with its path in the module. In the detection head, `cv2` predicts the box edges: three
# convolutions per scale. The first two are the most expensive ones of the head and stay in half precision.
HALF_IN_HEAD = r"(?:one2one_)?cv2\.\d+\.[01]\."


def marked(network: bytes, head: int) -> bytes:
    """OpenVINO's XML of a network, with the layers that must stay in single precision marked.

    If no layer has the expected name (a later version may name them differently), the XML is returned unchanged and a
    warning is logged. The marks have no effect in single precision.
    """
    root = ElementTree.fromstring(network)
    in_head = re.compile(rf"__module\.model\.model\.{head}\.(?!{HALF_IN_HEAD})")
    precise_layers = [
        layer
        for layer in root.iterfind("layers/layer")
        if layer.get("type") in CONVOLUTIONS and in_head.match(layer.get("name", ""))
    ]
    if not precise_layers:
        LOG.warning("the detection head was not found in OpenVINO's file; boxes in bfloat16 are less accurate")
        return network
    for layer in precise_layers:
        runtime_info = layer.find("rt_info")
        if runtime_info is None:
            runtime_info = ElementTree.SubElement(layer, "rt_info")
        ElementTree.SubElement(runtime_info, "attribute", PRECISE)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)


# Input that the network is traced with. Its axes have different lengths, so that the tracer cannot confuse them.
EXAMPLE_SHAPE = (2, 64, 96, 3)
# Deprecation warning of TorchScript. Its successor cannot export these networks with dynamic sizes.
DEPRECATION_WARNING = r"`torch\.jit\."


@dataclass(frozen=True, eq=False)
class Export:
    """A converted network.

    Attributes:
        parts: the content of its files, by name.
    """

    facts: NetworkFacts
    parts: Mapping[str, bytes]


def export(weights: Path) -> Export:
    """Converts a network. The graph accepts any batch size and any image size that is a multiple of the stride."""
    torch, runtime = api().torch, openvino()
    module, facts = raw_network(weights, torch.device("cpu"))
    head = len(module.model.model) - 1
    module.model.model[head].dynamic = True  # anchors follow the image's size instead of being recorded
    example = torch.zeros(EXAMPLE_SHAPE, dtype=torch.uint8)
    try:
        with TemporaryDirectory() as temporary, warnings.catch_warnings():
            # Torch warns of all Python code that branches on shapes.
            warnings.filterwarnings("ignore", category=torch.jit.TracerWarning)
            warnings.filterwarnings("ignore", DEPRECATION_WARNING)
            with torch.inference_mode():
                traced = torch.jit.trace(module, example, strict=False, check_trace=False)
            model = runtime.convert_model(traced, example_input=example)
            model.reshape([-1, -1, -1, 3])
            # float16 weights would save disk space but cost accuracy.
            runtime.save_model(model, Path(temporary) / "network.xml", compress_to_fp16=False)
            parts = {path.name: read_file(path, NETWORK_BYTES) for path in Path(temporary).iterdir()}
            return Export(facts, parts | {"network.xml": marked(parts["network.xml"], head)})
    except Exception as error:  # torch and the converter raise many types
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise DetectionError(
            f"{weights}: cannot be converted for OpenVINO ({reason}); use --backend torch for this model"
        ) from error


# Increase when this code changes its output for the same weights and packages.
REVISION = 3
# An export is repeated when the version of one of these packages changes.
PACKAGES = ("torch", "ultralytics-opencv-headless", "openvino")


def export_key(weights_sha256: str) -> str:
    """Cache key of an export: SHA-256 of the weights' digest, the package versions and the revision of the export."""
    inputs = json.dumps([REVISION, weights_sha256, {name: _version(name) for name in PACKAGES}], sort_keys=True)
    return hashlib.sha256(inputs.encode()).hexdigest()


def one_at_a_time() -> FolderLock:
    """A lock with which only one process of the user converts at a time.

    Workers start together, one per core. If each loaded torch at once, the machine could run out of memory. The
    operating system releases the lock when a process dies. Without file locks (Windows), processes do not wait.
    """
    folder = _place("").parent
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    return lock_folder(folder, waits=True)


def find_export(key: str) -> Export | None:
    """Reads an export from the user's cache; None if it has no valid copy."""
    path = _place(key)
    if not path.exists():
        return None
    try:
        with open_tensors(path, "numpy", "exporting again") as file:
            parts = {name: file.get_tensor(name).tobytes() for name in file.keys()}  # noqa: SIM118
            facts = dict(file.metadata() or {})
        if facts["sha256"] != _digest(key, parts):
            raise DetectionError(f"{path}: damaged; exporting again")
        export = Export(NetworkFacts.model_validate_json(facts["network"]), parts)
    except (DetectionError, KeyError, ValidationError) as error:
        LOG.warning("a converted network cannot be read, exporting again: %s", error)
        return None
    with suppress(OSError):
        os.utime(path)  # the least recently used exports are removed
    return export


def keep_export(key: str, export: Export) -> None:
    """Stores an export in the user's cache, and removes the least recently used ones.

    Never beside the weights: those may lie in a project that somebody else made, and an export found there could be
    anything. If the cache is not writable, a warning is logged, and the export is repeated each time.
    """
    from safetensors.numpy import save

    path = _place(key)
    facts = {"network": export.facts.model_dump_json(), "sha256": _digest(key, export.parts)}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, save({name: np.frombuffer(part, np.uint8) for name, part in export.parts.items()}, facts))
    except OSError as error:
        LOG.warning("a converted network cannot be stored, so it is converted each time: %s", error)
        return
    forget_oldest(path.parent)


def _place(key: str) -> Path:
    return cache_dir() / "exports" / f"openvino-{key}.safetensors"


def _digest(key: str, parts: Mapping[str, bytes]) -> str:
    return hashlib.sha256(b"".join([key.encode(), *(parts[name] for name in sorted(parts))])).hexdigest()


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
