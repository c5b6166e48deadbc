"""What is different on an NVIDIA graphics processor: half precision, and graphs that are recorded once and replayed.

A small network is a few hundred kernels of some microseconds each; started one by one from Python they keep the
processor busier than the graphics processor. A CUDA graph starts them all at once. It is recorded for one shape, so
pictures are filled up to the next of a few batch sizes, and a bounded number of graphs is kept.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

from annotator.detection.ultralytics_api import api

BATCH_SIZES = (1, 2, 4, 8, 16, 32)
MAX_GRAPHS = 32
# Runs before a recording, in which libraries choose their kernels and take their memory.
WARM_UP_RUNS = 3

Run = Callable[[Any], Any]


class CudaRunner:
    """Runs a module through graphs of a few shapes."""

    def __init__(self, module: Any, record: Callable[[Any, Any], Run] | None = None) -> None:
        """
        Args:
            module: from (n, height, width, 3) uint8 to its answer.
            record: makes a replayable run of a module from an example of its input; None: a CUDA graph.
        """
        self._module = module
        self._record = record or record_graph
        self._graphs: OrderedDict[tuple[int, ...], Run] = OrderedDict()

    def __call__(self, pixels: Any) -> Any:
        """The module's answer; a batch of any size."""
        number, largest = len(pixels), BATCH_SIZES[-1]
        if number > largest:
            parts = [self(pixels[begin : begin + largest]) for begin in range(0, number, largest)]
            return api().torch.cat(parts)
        size = next(size for size in BATCH_SIZES if size >= number)
        if size > number:
            pixels = api().torch.cat([pixels, pixels[:1].expand(size - number, -1, -1, -1)])
        # A graph answers into the same memory each time.
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
    """A CUDA graph of a module for the example's shape; its answer stays valid until the next run."""
    torch = api().torch
    held = example.clone()
    stream = torch.cuda.Stream(example.device)
    stream.wait_stream(torch.cuda.current_stream(example.device))
    with torch.cuda.stream(stream), torch.backends.cudnn.flags(enabled=True, benchmark=True):
        for _ in range(WARM_UP_RUNS):
            module(held)
    torch.cuda.current_stream(example.device).wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        answer = module(held)
    # The network keeps anchors of the last shape only; this graph goes on to read the ones it was recorded with.
    anchors = anchors_of(module)

    def run(pixels: Any, _anchors: object = anchors) -> Any:
        held.copy_(pixels)
        graph.replay()
        return answer

    return run


def anchors_of(module: Any) -> tuple[Any, ...]:
    """The tensors that the detecting layer keeps from one call to the next."""
    head = module.model.model[-1]
    return head.anchors, head.strides


def decode_in_full_precision(module: Any) -> Any:
    """Has a network in half precision turn its last features into boxes in full precision.

    Half floats between 512 and 1024 are half a pixel apart: boxes on large pictures would be rounded to that.
    """
    torch = api().torch
    head = module.model.model[-1]
    decode = head._inference
    head.dfl.float()

    def in_full_precision(features: dict[str, Any]) -> Any:
        # Of the feature maps only shape and precision are looked at.
        shapes = [torch.empty((), device=f.device).expand(f.shape) for f in features["feats"]]
        full = {name: features[name].float() for name in ("boxes", "scores")}
        return decode({**full, "feats": shapes})

    head._inference = in_full_precision
    return module
