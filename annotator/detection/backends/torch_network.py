"""A network on torch: runs on every machine, and is the only backend for GPUs."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from annotator.detection.backends.network import Answer, Batch, NetworkFacts
from annotator.detection.config import Backend
from annotator.detection.ultralytics_api import api
from annotator.detection.weights import load_weights
from annotator.types.errors import DetectionError

# Makes a detection head give out how uncertain each edge is.
#
# A head with distribution focal loss (YOLOv8, 11 and others, not 26) predicts a distribution of the distance from an
# anchor to each edge. Ultralytics keeps only its mean. Here the graph also computes its standard deviation.


def give_edge_spread(head: Any) -> bool:
    """Replaces the decoding of a head; its output gains four rows: the spread of each edge, pixels.

    The means become weighted sums, because OpenVINO would compute ultralytics' convolution, and the softmax before
    it, in half precision.

    Returns:
        False if the head predicts distances directly; it is then left as it is.
    """
    torch = api().torch
    bins = getattr(head.dfl, "c1", None)
    if bins is None:
        return False
    decode = head._inference

    def with_spread(features: dict[str, Any]) -> Any:
        logits = features["boxes"]
        images, _, anchors = logits.shape
        shares = logits.view(images, 4, bins, anchors).softmax(2)
        distances = torch.arange(bins, dtype=logits.dtype, device=logits.device).view(1, 1, bins, 1)
        mean = (shares * distances).sum(2, keepdim=True)
        answer = decode({**features, "boxes": mean[:, :, 0]})  # also sets the strides
        # not the mean of squares minus the square of the mean, which would round to noise for narrow distributions
        apart = distances - mean
        spread = (shares * apart * apart).sum(2).sqrt()
        return torch.cat((answer, spread * head.strides), 1)

    head.dfl = torch.nn.Identity()  # `decode` gets the means
    head._inference = with_spread
    return True


# The part of a YOLO that all backends run: pixels in, raw prediction out.
#
# The input is uint8, so that the conversion to floats is part of the graph. The graph ends before ultralytics'
# selection of boxes, because a graph without the selection is smaller and accepts any size.


def raw_network(weights: Path, device: Any) -> tuple[Any, NetworkFacts]:
    """A torch module from (n, height, width, 3) uint8 to the raw prediction of `network.Answer`, and its facts.

    Batch normalisation is folded into the convolutions.
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


# Maximum number of pixels per forward pass; it bounds the memory to about 1 GB for a nano model.
MAX_BATCH_PX = 32 * 320 * 320


class TorchNetwork:
    """A network that torch runs on the CPU or a GPU, in single precision."""

    backend: Backend = "torch"

    def __init__(self, weights: Path, device: Any, threads: int | None = None) -> None:
        module, self.facts = raw_network(weights, device)
        self._device = device
        self.device = str(device)
        self._threads = threads
        self._run = module.to(memory_format=api().torch.channels_last)
        # Needed because the network caches the last size's anchors, and torch's number of threads is global.
        self._lock = threading.Lock()

    def predict(self, batches: Sequence[Batch]) -> list[Answer]:
        """One raw prediction per batch, as `yolo.candidates` reads it, with at most `MAX_BATCH_PX` per forward pass."""
        answers = []
        with self._lock, _threads(self._threads):
            for batch in batches:
                at_once = max(MAX_BATCH_PX // (batch.shape[1] * batch.shape[2]), 1)
                parts = [self._predict(batch[begin : begin + at_once]) for begin in range(0, len(batch), at_once)]
                answers.append(np.concatenate(parts))
        return answers

    def _predict(self, batch: Batch) -> Answer:
        torch = api().torch
        try:
            with torch.inference_mode():
                answer: Answer = self._run(torch.from_numpy(batch).to(self._device)).cpu().numpy()
        except RuntimeError as error:
            reason = str(error).strip().splitlines()[0]
            raise DetectionError(f"torch cannot run the detector on {self._device} ({reason})") from error
        return answer


@contextmanager
def _threads(number: int | None) -> Iterator[None]:
    """Limits torch to this number of CPU threads; None: no change."""
    if number is None:
        yield
        return
    torch = api().torch
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)
