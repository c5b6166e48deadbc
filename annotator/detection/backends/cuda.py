"""Runs a network on an NVIDIA GPU with CUDA graphs, in half precision except for the decoding of boxes.

A small network is a few hundred kernels of some microseconds each. Launching them one by one from Python takes the CPU
longer than the GPU needs to compute them; a CUDA graph launches all of them at once. A graph is recorded for one input
shape, so batches are padded to the next of a few batch sizes, and the number of cached graphs is bounded.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

from annotator.detection.ultralytics_api import api

BATCH_SIZES = (1, 2, 4, 8, 16, 32)
MAX_GRAPHS = 32
# Runs before a recording, in which the libraries select kernels and allocate memory.
WARM_UP_RUNS = 3

Run = Callable[[Any], Any]


class CudaRunner:
    """Runs a module through one cached graph per input shape."""

    def __init__(self, module: Any, record: Callable[[Any, Any], Run] | None = None) -> None:
        """
        Args:
            module: maps (n, height, width, 3) uint8 to the raw prediction.
            record: records a module for the shape of an example input; None: `record_graph`.
        """
        self._module = module
        self._record = record or record_graph
        self._graphs: OrderedDict[tuple[int, ...], Run] = OrderedDict()

    def __call__(self, pixels: Any) -> Any:
        """The module's output for a batch of any size."""
        number, largest = len(pixels), BATCH_SIZES[-1]
        if number > largest:
            parts = [self(pixels[begin : begin + largest]) for begin in range(0, number, largest)]
            return api().torch.cat(parts)
        size = next(size for size in BATCH_SIZES if size >= number)
        if size > number:
            pixels = api().torch.cat([pixels, pixels[:1].expand(size - number, -1, -1, -1)])
        # A graph writes its output to the same memory each time.
        return self._graph(pixels)(pixels)[:number].clone()

    def _graph(self, pixels: Any) -> Run:
        shape = tuple(pixels.shape)
        if shape not in self._graphs:
            if len(self._graphs) >= MAX_GRAPHS:
                self._graphs.popitem(last=False)
            self._graphs[shape] = self._record(self._module, pixels)
        self._graphs.move_to_end(shape)
        return self._graphs[shape]


def record_graph(module: Any, example: Any) -> Run:
    """Records a CUDA graph of a module for the example's shape; its output stays valid until the next run."""
    torch = api().torch
    static_input = example.clone()
    stream = torch.cuda.Stream(example.device)
    stream.wait_stream(torch.cuda.current_stream(example.device))
    with torch.cuda.stream(stream), torch.backends.cudnn.flags(enabled=True, benchmark=True):
        for _ in range(WARM_UP_RUNS):
            module(static_input)
    torch.cuda.current_stream(example.device).wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        answer = module(static_input)
    # The network caches the anchors of the last shape only, but this graph reads the ones it was recorded with.
    anchors = anchors_of(module)

    def run(pixels: Any, _anchors: object = anchors) -> Any:
        static_input.copy_(pixels)
        graph.replay()
        return answer

    return run


def anchors_of(module: Any) -> tuple[Any, ...]:
    """The anchors and strides that the detection head caches between calls."""
    head = module.model.model[-1]
    return head.anchors, head.strides


def decode_in_full_precision(module: Any) -> Any:
    """Makes the detection head of a half-precision network decode boxes in single precision.

    Half floats between 512 and 1024 have a spacing of 0.5, so box coordinates on large images would be rounded to
    half a pixel.
    """
    torch = api().torch
    head = module.model.model[-1]
    decode = head._inference

    def in_full_precision(features: dict[str, Any]) -> Any:
        # The decoding reads only the shape and the type of the feature maps.
        shapes = [torch.empty((), device=f.device).expand(f.shape) for f in features["feats"]]
        full = {name: features[name].float() for name in ("boxes", "scores")}
        return decode({**full, "feats": shapes})

    head._inference = in_full_precision
    return module
