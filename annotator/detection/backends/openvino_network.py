"""A network on OpenVINO: the fastest of the backends on x86 processors.

A canvas size is compiled by itself when it first comes, for one picture and for several together. The same network
compiled once for all sizes costs about half as much again a picture (docs/detector_backends.md), and a detector sees
few sizes.
"""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict, deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from annotator.detection.backends.cores import rejoined, side_by_side, single, usable_cores
from annotator.detection.backends.network import Answer, Batch, NetworkFacts
from annotator.detection.backends.openvino_api import openvino
from annotator.detection.config import Backend
from annotator.types.errors import DetectionError

LOG = logging.getLogger("annotator.detectors")

# So many compiled sizes are kept, about 30 MB each for a nano model; the one that was not used for longest goes.
MAX_COMPILED = 24
# Small pictures are computed so many together, which takes a fifth to a quarter less time than one by one. Larger ones
# gain nothing by it.
TOGETHER = (6, 3)
SMALL_PX = 128 * 128
# A stream is a picture in work. Each has buffers of its own, so machines of many cores give it several.
MAX_STREAMS = 8
# Pictures under way for each stream: one in work and one that waits for it.
IN_FLIGHT = 2


@dataclass(frozen=True, eq=False)
class _Request:
    """A request with numpy's views of its memory, which are made once: making them takes longer than filling them."""

    request: Any
    pixels: np.ndarray
    answer: np.ndarray


class OpenVinoNetwork:
    """A network on the processor, through OpenVINO.

    Attributes:
        backend: "openvino", or "openvino-bf16" in half precision.
        device: "cpu".
        facts: its classes and stride.
    """

    device = "cpu"

    def __init__(
        self, facts: NetworkFacts, parts: Mapping[str, bytes], threads: int | None, *, bfloat16: bool = False
    ) -> None:
        """
        Args:
            facts: what is known of it.
            parts: network.xml and network.bin of its export.
            threads: None: all cores that the process may use.
            bfloat16: compute in it, with what `half_precision` leaves out.

        Raises:
            DetectionError: OpenVINO is missing or cannot read the export.
        """
        self.backend: Backend = "openvino-bf16" if bfloat16 else "openvino"
        self.facts = facts
        self._threads = threads or usable_cores()
        self._core = openvino().Core()
        try:
            self._model = self._core.read_model(parts["network.xml"], parts["network.bin"])
        except Exception as error:  # RuntimeError and others, by version
            raise DetectionError(f"OpenVINO cannot read the exported detector ({_reason(error)})") from error
        # One call at a time: it keeps all cores busy by itself.
        self._lock = threading.Lock()
        self._compiled: OrderedDict[tuple[tuple[int, ...], int], list[_Request]] = OrderedDict()
        self._joins: dict[tuple[tuple[int, ...], int], bool] = {}

    def predict(self, batches: Sequence[Batch]) -> list[Answer]:
        """As `Network.predict`; sizes that come for the first time are compiled before.

        Raises:
            DetectionError: OpenVINO fails.
        """
        count = sum(len(batch) for batch in batches)
        streams = min(self._threads, MAX_STREAMS) if side_by_side(count, self._threads) else 1
        try:
            with self._lock:
                parts = [part for batch in batches for part in _cut(batch, self._lengths(batch, streams))]
                return rejoined(self._run(parts, streams), batches)
        except Exception as error:
            raise DetectionError(
                f"OpenVINO cannot run the detector ({_reason(error)}); use the backend torch"
            ) from error

    def _lengths(self, batch: Batch, streams: int) -> list[int]:
        """How many pictures of a batch are computed together in each of its parts: as many parts for each stream."""
        left, lengths = len(batch), list[int]()
        if left // streams >= min(TOGETHER) and self._may_join(batch.shape[1:], streams):
            for together in TOGETHER:
                parts = left // streams // together * streams
                lengths += [together] * parts
                left -= parts * together
        return lengths + [1] * left

    def _may_join(self, size: tuple[int, ...], streams: int) -> bool:
        """Whether pictures of a size have the same answers together as alone, to the bit: tried once.

        They have where the runtime adds up in the same order for one picture as for several, which it does not promise.
        """
        if size[0] * size[1] > SMALL_PX:
            return False
        if (size, streams) not in self._joins:
            some = np.random.default_rng(0).integers(0, 256, (max(TOGETHER), *size), np.uint8)
            self._requests({(n, *size) for n in (*TOGETHER, 1)}, streams)  # compiles them side by side
            alone = np.concatenate(list(self._run(single([some]), streams)))
            answers = [answer for n in TOGETHER for answer in self._run([some[:n]], streams)]
            self._joins[size, streams] = all(np.array_equal(answer, alone[: len(answer)]) for answer in answers)
            if not self._joins[size, streams]:
                LOG.info("pictures of %s are computed one by one: together their answers differ", size)
        return self._joins[size, streams]

    def _run(self, parts: Sequence[Batch], streams: int) -> Iterator[Answer]:
        """One answer a part. As many are under way as keep all streams busy while the oldest answer is taken."""
        free = self._requests({part.shape for part in parts}, streams)
        under_way: deque[tuple[tuple[int, ...], _Request]] = deque()

        def oldest() -> Answer:
            shape, request = under_way.popleft()
            request.request.wait()
            free[shape].append(request)
            return request.answer.copy()

        try:
            for part in parts:
                if len(under_way) == IN_FLIGHT * streams:
                    yield oldest()
                request = free[part.shape].pop()
                request.pixels[...] = part
                request.request.start_async()
                under_way.append((part.shape, request))
            while under_way:
                yield oldest()
        finally:
            for _, request in under_way:  # after a failure
                request.request.wait()

    def _requests(self, shapes: set[tuple[int, ...]], streams: int) -> dict[tuple[int, ...], list[_Request]]:
        """The requests of each of the shapes; shapes that are new are compiled side by side."""
        new = [shape for shape in sorted(shapes) if (shape, streams) not in self._compiled]
        if new:
            with ThreadPoolExecutor(min(self._threads, len(new))) as pool:
                made = pool.map(lambda shape: self._compile(shape, streams), new)
                self._compiled.update({(shape, streams): requests for shape, requests in zip(new, made, strict=True)})
        for shape in shapes:
            self._compiled.move_to_end((shape, streams))
        found = {shape: list(self._compiled[shape, streams]) for shape in shapes}
        while len(self._compiled) > MAX_COMPILED:
            self._compiled.popitem(last=False)
        return found

    def _compile(self, shape: tuple[int, ...], streams: int) -> list[_Request]:
        model = self._model.clone()
        model.reshape(list(shape))
        compiled = self._core.compile_model(
            model,
            "CPU",
            {
                "NUM_STREAMS": streams,
                "INFERENCE_NUM_THREADS": self._threads,
                # Threads bound to cores would wait on one core for those of other sizes and processes.
                "ENABLE_CPU_PINNING": False,
                # Left to itself, OpenVINO takes half precision where the processor has it.
                "INFERENCE_PRECISION_HINT": "bf16" if self.backend == "openvino-bf16" else "f32",
            },
        )
        requests = [compiled.create_infer_request() for _ in range(IN_FLIGHT * streams)]
        return [_Request(r, r.get_input_tensor().data, r.get_output_tensor().data) for r in requests]


def _cut(batch: Batch, lengths: Sequence[int]) -> list[Batch]:
    """The parts of a batch, one after the other."""
    ends = np.cumsum(lengths)
    return [batch[end - length : end] for end, length in zip(ends, lengths, strict=True)]


def _reason(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__
