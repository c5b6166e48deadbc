"""The part of a YOLO that all backends run: pixels in, raw prediction out.

The input is uint8, so that the conversion to floats is part of the graph. The graph ends before ultralytics' selection
of boxes, because a graph without the selection is smaller and accepts any size.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from annotator.detection.backends.edge_spread import give_edge_spread
from annotator.detection.backends.network import NetworkFacts
from annotator.detection.ultralytics_api import api
from annotator.detection.weights import load_weights


def raw_network(weights: Path, device: Any) -> tuple[Any, NetworkFacts]:
    """A torch module from (n, height, width, 3) uint8 to the raw prediction of `network.Answer`, and its facts.

    Batch normalisation is folded into the convolutions.

    Raises:
        DetectionError: the weights cannot be used.
    """
    model = load_weights(weights, device)
    head = model.model[-1]
    model = model.fuse(verbose=False).eval().requires_grad_(False)
    end2end = bool(head.end2end)
    head.export = True  # returns the prediction only, without the tensors for training
    head.postprocess = _unchanged
    labels = tuple(str(model.names[number]) for number in sorted(model.names))
    stride = max(int(model.stride.max()), 32)
    facts = NetworkFacts(labels=labels, stride=stride, end2end=end2end, edge_spread=give_edge_spread(head))
    return _with_pixels(model, end2end), facts


def _unchanged(prediction: Any) -> Any:
    return prediction


def _with_pixels(model: Any, end2end: bool) -> Any:
    torch = api().torch

    class PixelsIn(torch.nn.Module):  # type: ignore[name-defined]
        def __init__(self) -> None:
            super().__init__()
            self.model = model

        def forward(self, pixels: Any) -> Any:
            # The memory layout is (n, row, column, colour). Permuted to (n, colour, row, column) it is channels-last,
            # the layout in which networks are fastest.
            answer = self.model(pixels.permute(0, 3, 1, 2).to(next(self.model.parameters()).dtype) / 255)
            return answer.permute(0, 2, 1) if end2end else answer

    return PixelsIn().eval()
