"""Exports a trained network to the file formats of other runtimes. The export needs torch; running it does not."""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from xml.etree import ElementTree

from annotator.detection.backends.network import ExportKind, NetworkFacts
from annotator.detection.backends.openvino_network import openvino
from annotator.detection.backends.torch_network import raw_network
from annotator.detection.ultralytics_api import api
from annotator.files import NETWORK_BYTES, read_file
from annotator.types.errors import DetectionError

# TODO-MERGED docstring of half_precision.py:
# Keeps parts of the detection head in single precision while OpenVINO computes the network in bfloat16.
#
# OpenVINO keeps the layers after the last convolutions in single precision, and also layers that are marked as precise.
# The changes made here reduce the error of box edges to a third and that of scores to two thirds, at almost no cost in
# time (docs/detector_backends.md).


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

    Args:
        network: content of the XML file.
        head: index of the detection head in the module.
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
# The newest opset that all package versions allowed by pyproject.toml support.
ONNX_OPSET = 17
# Deprecation warnings of TorchScript. Its successor cannot export these networks with dynamic sizes.
DEPRECATION_WARNINGS = (
    r"`torch\.jit\.",
    "You are using the legacy TorchScript-based ONNX export",
    "The feature will be removed",
)


def export(weights: Path, kind: ExportKind) -> tuple[NetworkFacts, dict[str, bytes]]:
    """Converts a network; returns its facts and the file contents by name.

    The files are network.xml and network.bin for OpenVINO, network.onnx for ONNX Runtime. The graph accepts any batch
    size and any image size that is a multiple of the stride.

    Raises:
        DetectionError: the weights cannot be used, a package is missing, or the network cannot be converted.
    """
    torch = api().torch
    module, facts = raw_network(weights, torch.device("cpu"))
    module.model.model[-1].dynamic = True  # anchors follow the image's size instead of being recorded
    try:
        with TemporaryDirectory() as temporary, warnings.catch_warnings():
            # Torch warns of all Python code that branches on shapes.
            warnings.filterwarnings("ignore", category=torch.jit.TracerWarning)
            for message in DEPRECATION_WARNINGS:
                warnings.filterwarnings("ignore", message)
            _WRITERS[kind](module, torch.zeros(EXAMPLE_SHAPE, dtype=torch.uint8), Path(temporary))
            return facts, {path.name: read_file(path, NETWORK_BYTES) for path in sorted(Path(temporary).iterdir())}
    except DetectionError:
        raise
    except Exception as error:  # torch and the converters raise many types
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise DetectionError(
            f"{weights}: cannot be converted for {kind} ({reason}); use --backend torch for this model"
        ) from error


def _write_openvino(module: Any, example: Any, folder: Path) -> None:
    runtime, torch = openvino(), api().torch
    with torch.inference_mode():
        traced = torch.jit.trace(module, example, strict=False, check_trace=False)
    model = runtime.convert_model(traced, example_input=example)
    model.reshape([-1, -1, -1, 3])
    # float16 weights would save disk space but cost accuracy.
    file = folder / "network.xml"
    runtime.save_model(model, file, compress_to_fp16=False)
    file.write_bytes(marked(read_file(file, NETWORK_BYTES), len(module.model.model) - 1))


def _write_onnx(module: Any, example: Any, folder: Path) -> None:
    torch = api().torch
    torch.onnx.export(
        module,
        (example,),
        folder / "network.onnx",
        dynamo=False,
        opset_version=ONNX_OPSET,
        input_names=["pixels"],
        output_names=["prediction"],
        dynamic_axes={"pixels": {0: "n", 1: "height", 2: "width"}, "prediction": {0: "n", 2: "anchors"}},
    )


_WRITERS: dict[ExportKind, Callable[[Any, Any, Path], None]] = {
    "openvino": _write_openvino,
    "onnxruntime": _write_onnx,
}
