"""A network on torch: runs on every machine, and is the only backend for GPUs."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from annotator.detection.backends.network import Answer, Batch
from annotator.detection.backends.raw_network import raw_network
from annotator.detection.config import Backend
from annotator.detection.ultralytics_api import api
from annotator.types.errors import DetectionError

# Maximum number of pixels per forward pass; it bounds the memory to about 1 GB for a nano model.
MAX_BATCH_PX = 32 * 320 * 320


class TorchNetwork:
    """A network that torch runs on the CPU or a GPU, in single precision.

    Attributes:
        backend: "torch".
        device: device in torch's notation.
        facts: its classes, stride and kind of output.
    """

    backend: Backend = "torch"

    def __init__(self, weights: Path, device: Any, threads: int | None = None) -> None:
        """
        Args:
            weights: weights file of an ultralytics detection model.
            device: a torch device, as returned by `pick_device`.
            threads: CPU threads; None: torch's default.

        Raises:
            DetectionError: the weights cannot be used.
        """
        module, self.facts = raw_network(weights, device)
        self._device = device
        self.device = str(device)
        self._threads = threads
        self._run = module.to(memory_format=api().torch.channels_last)
        # Needed because the network caches the last size's anchors, and torch's number of threads is global.
        self._lock = threading.Lock()

    def predict(self, batches: Sequence[Batch]) -> list[Answer]:
        """As `Network.predict`, with at most `MAX_BATCH_PX` per forward pass.

        Raises:
            DetectionError: torch fails, for example because it is out of memory.
        """
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
