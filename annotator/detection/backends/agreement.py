"""Compares the output of a backend with torch in single precision on the CPU.

The allowed difference depends on the network and the CPU, so it is measured: torch runs the network in a second
precision (the reference). The bound is the reference's distance from torch's single precision, times `TOLERANCE`.

- Single precision: the reference is double precision. The distance is the rounding error of single precision. The same
  sums in another order have an error of that size.
- bfloat16, and float16 for CUDA: the reference is the whole network in that precision, on the CPU. Backends compute a
  part of it in single precision, so their error should be smaller.

A wrong graph, a wrong kernel or lost weights cause much larger errors: boxes differ by pixels, which in single
precision is thousands of times the bound.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from annotator.detection.backends.export import export
from annotator.detection.backends.network import Answer, Network
from annotator.detection.backends.torch_network import TorchNetwork, raw_network
from annotator.detection.ultralytics_api import api, pick_device
from annotator.types.errors import DetectionError

# Allowed error as a multiple of the reference's error. Winograd convolutions, which some backends use, lose up to three
# binary digits.
TOLERANCE = {"float64": 8.0, "bfloat16": 2.0, "float16": 2.0}


class BackendMissingError(DetectionError):
    """A backend cannot be tested: it is not installed, or the CPU lacks its instructions."""


@dataclass(frozen=True)
class Agreement:
    """Root mean square difference between the raw output of a backend and that of torch.

    Attributes:
        boxes_px, boxes_bound_px: difference of the box coordinates and its upper bound, pixels.
        scores, scores_bound: difference of the scores (0 to 1) and its upper bound.
        spreads_px, spreads_bound_px: difference of the edges' spreads and its upper bound, pixels; 0 without spreads.
        reference: precision that the bounds were measured with.
    """

    boxes_px: float
    boxes_bound_px: float
    scores: float
    scores_bound: float
    spreads_px: float
    spreads_bound_px: float
    reference: str

    @property
    def holds(self) -> bool:
        """Whether the differences are within their bounds; False for NaN and infinity."""
        return (
            self.boxes_px <= self.boxes_bound_px
            and self.scores <= self.scores_bound
            and self.spreads_px <= self.spreads_bound_px
        )


class Agreements:
    """Compares backends on one network and one set of images."""

    def __init__(self, weights: Path, images: UInt8[np.ndarray, "n h w 3"]) -> None:
        """
        Args:
            images: RGB images; height and width are multiples of the network's stride.
        """
        self._weights, self._images = weights, images
        torch = TorchNetwork(weights, pick_device("cpu"))
        self._edge_spread = torch.facts.edge_spread
        self._expected = self._answer(torch)
        self._distances: dict[str, tuple[float, float, float]] = {}

    def of(self, open_network: Callable[[Path], Network]) -> Agreement:
        """Compares one backend with torch.

        Args:
            open_network: opens the weights file on the backend, such as one of `openers()`.

        Raises:
            BackendMissingError: the backend is not installed or not supported by the CPU.
        """
        network = open_network(self._weights)
        reference = "float64"
        if network.backend == "openvino-bf16":
            reference = "bfloat16"
        elif network.device.startswith("cuda"):
            reference = "float16"  # torch multiplies with TF32 there, which has as many digits
        found, allowed = self._distance(self._answer(network)), self._reference(reference)
        (boxes, scores, spreads), factor = found, TOLERANCE[reference]
        bounds = [factor * distance for distance in allowed]
        return Agreement(boxes, bounds[0], scores, bounds[1], spreads, bounds[2], reference)

    def _answer(self, network: Network) -> Answer:
        return network.predict([self._images])[0]

    def _distance(self, answer: Float[np.ndarray, "_ _ _"]) -> tuple[float, float, float]:
        """Root mean square differences of boxes, scores and spreads."""
        if answer.shape != self._expected.shape:
            raise DetectionError(f"the output has shape {answer.shape}, torch's has {self._expected.shape}")
        squares = (answer.astype(np.float64) - self._expected) ** 2
        end = squares.shape[1] - (4 if self._edge_spread else 0)
        boxes, scores = float(np.sqrt(squares[:, :4].mean())), float(np.sqrt(squares[:, 4:end].mean()))
        return boxes, scores, float(np.sqrt(squares[:, end:].mean())) if self._edge_spread else 0.0

    def _reference(self, precision: str) -> tuple[float, float, float]:
        if precision not in self._distances:
            torch = api().torch
            module, _ = raw_network(self._weights, torch.device("cpu"))
            module = module.to(getattr(torch, precision))
            with torch.inference_mode():
                answer = module(torch.from_numpy(self._images)).double().numpy()
            self._distances[precision] = self._distance(answer)
        return self._distances[precision]


def openers(cuda_devices: Sequence[str]) -> dict[str, Callable[[Path], Network]]:
    """For each backend except torch on the CPU: a function that opens a weights file. Exports are kept in memory only.

    Args:
        cuda_devices: names of CUDA devices to test torch on, such as "cuda:0".
    """
    exported = lru_cache(export)  # used for both precisions of OpenVINO

    def openvino_network(weights: Path, *, bfloat16: bool) -> Network:
        from annotator.detection.backends.openvino_network import OpenVinoNetwork, computes_bfloat16, openvino

        if find_spec("openvino") is None:
            raise BackendMissingError("not installed")
        openvino()  # reports a broken package before the slow export
        if bfloat16 and not computes_bfloat16():
            raise BackendMissingError("the processor does not support bfloat16")
        return OpenVinoNetwork(*exported(weights, "openvino"), None, bfloat16=bfloat16)

    def onnx_network(weights: Path) -> Network:
        from annotator.detection.backends.onnx_network import OnnxNetwork

        if find_spec("onnxruntime") is None or find_spec("onnx") is None:
            raise BackendMissingError("not installed (extra onnx)")
        return OnnxNetwork(*exported(weights, "onnxruntime"), None)

    by_name: dict[str, Callable[[Path], Network]] = {
        "openvino": partial(openvino_network, bfloat16=False),
        "openvino-bf16": partial(openvino_network, bfloat16=True),
        "onnxruntime": onnx_network,
    }
    for device in cuda_devices:
        by_name[f"torch, {device}"] = partial(_torch_network, device=device)
    return by_name


def _torch_network(weights: Path, *, device: str) -> Network:
    return TorchNetwork(weights, pick_device(device))
