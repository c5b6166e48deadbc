"""A network on OpenVINO, the fastest backend on x86 processors. Only this module imports it; its telemetry is off.

The network is compiled for each canvas size on first use, for single images and for batches. Compiled once with
dynamic sizes, it takes about 1.5 times as long per image (docs/notebook.md), and a detector uses few sizes.
"""

from __future__ import annotations

import logging
import sys
import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import lru_cache
from typing import Any

import numpy as np

from annotator.detection.backends.network import (
    Answer,
    Batch,
    NetworkFacts,
    rejoined,
    side_by_side,
    single,
    usable_cores,
)
from annotator.detection.config import Backend
from annotator.types.errors import DetectionError

# OpenVINO imports this package when it loads. The package sends telemetry and stores an id in the user's home. OpenVINO
# works without it.
TELEMETRY = "openvino_telemetry"

_LOCK = threading.Lock()


def openvino() -> Any:
    """The module `openvino`, loaded on the first call."""
    with _LOCK:
        return _load()


def computes_bfloat16() -> bool:
    """Whether the CPU has instructions for bfloat16 (AVX512-BF16, AMX, AVX2-VNNI-2) and OpenVINO uses them."""
    runtime = openvino()
    try:
        return "BF16" in runtime.Core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")
    except RuntimeError as error:
        reason = (str(error).strip() or "no reason given").splitlines()[-1]
        raise DetectionError(f"OpenVINO cannot use the processor ({reason}); use the backend torch") from error


@lru_cache(maxsize=1)
def _load() -> Any:
    hidden = TELEMETRY not in sys.modules
    if hidden:
        sys.modules[TELEMETRY] = None  # type: ignore[assignment]  # None makes an import of it fail
    try:
        import openvino as module
        import openvino.tools.ovc.convert_impl  # else the first conversion imports it with telemetry
    except ImportError as error:
        raise DetectionError(f"OpenVINO cannot be loaded ({error}); run: pip install openvino") from error
    finally:
        if hidden:
            del sys.modules[TELEMETRY]
    # The bindings initialise their numpy support on first use. If two threads do this at once, they deadlock: one holds
    # Python's lock, the other the bindings' own. So it is done here.
    module.Type.u8.to_dtype()
    _ = module.Tensor(np.zeros(1, np.uint8)).data
    return module


LOG = logging.getLogger("annotator.detectors")

# Maximum number of cached compiled input shapes, about 30 MB each for a nano model; the least recently used one is
# dropped.
MAX_COMPILED = 24
# Batch sizes for small images, which take 20 to 25 % less time in a batch than one by one. Larger images do not.
TOGETHER = (6, 3)
SMALL_PX = 128 * 128
# A stream computes one request at a time and has its own buffers. With more cores than streams, each
# stream uses several cores.
MAX_STREAMS = 8
# Requests in flight per stream: one in computation and one waiting.
IN_FLIGHT = 2


class OpenVinoNetwork:
    """A network that OpenVINO runs on the CPU.

    Attributes:
        backend: "openvino", or "openvino-bf16" in half precision.
    """

    device = "cpu"

    def __init__(
        self, facts: NetworkFacts, parts: Mapping[str, bytes], threads: int | None, *, bfloat16: bool = False
    ) -> None:
        self.backend: Backend = "openvino-bf16" if bfloat16 else "openvino"
        self.facts = facts
        self._threads = threads or usable_cores()
        self._core = openvino().Core()
        try:
            self._model = self._core.read_model(parts["network.xml"], parts["network.bin"])
        except Exception as error:  # the type depends on OpenVINO's version
            raise DetectionError(f"OpenVINO cannot read the exported detector ({_reason(error)})") from error
        # One call at a time: a single call uses all cores.
        self._lock = threading.Lock()
        self._compiled: OrderedDict[tuple[tuple[int, ...], int], Any] = OrderedDict()
        self._joins: dict[tuple[tuple[int, ...], int], bool] = {}

    def predict(self, batches: Sequence[Batch]) -> list[Answer]:
        """One raw prediction per batch, as `yolo.candidates` reads it; new canvas sizes are compiled first."""
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
        """Lengths of the parts that a batch is cut into; each stream gets the same number of parts of each length."""
        left, lengths = len(batch), list[int]()
        if left // streams >= min(TOGETHER) and self._may_join(batch.shape[1:], streams):
            for together in TOGETHER:
                parts = left // streams // together * streams
                lengths += [together] * parts
                left -= parts * together
        return lengths + [1] * left

    def _may_join(self, size: tuple[int, ...], streams: int) -> bool:
        """Whether images of a size get exactly the same output in a batch as alone; tested once per size.

        This holds if the runtime adds in the same order for one image as for several, which is not guaranteed.
        """
        if size[0] * size[1] > SMALL_PX:
            return False
        if (size, streams) not in self._joins:
            noise = np.random.default_rng(0).integers(0, 256, (max(TOGETHER), *size), np.uint8)
            self._queues({(n, *size) for n in (*TOGETHER, 1)}, streams)  # compiles the shapes in parallel
            alone = np.concatenate(self._run(single([noise]), streams))
            answers = [answer for n in TOGETHER for answer in self._run([noise[:n]], streams)]
            self._joins[size, streams] = all(np.array_equal(answer, alone[: len(answer)]) for answer in answers)
            if not self._joins[size, streams]:
                LOG.info("images of size %s are computed one by one: in a batch their output differs", size)
        return self._joins[size, streams]

    def _run(self, parts: Sequence[Batch], streams: int) -> list[Answer]:
        """One answer per part, in order; enough requests are in flight to keep all streams busy."""
        queues, answers = self._queues({part.shape for part in parts}, streams), dict[int, Answer]()

        def keep(request: Any, number: int) -> None:
            answers[number] = request.get_output_tensor().data.copy()

        with ExitStack() as stack:
            for queue in queues.values():
                queue.set_callback(keep)
                stack.callback(queue.wait_all)  # after a failure, too: a busy queue takes no other call
            for number, part in enumerate(parts):
                queues[part.shape].start_async({0: part}, number)
        return [answers.pop(number) for number in range(len(parts))]  # the queues keep `answers` up to the next call

    def _queues(self, shapes: set[tuple[int, ...]], streams: int) -> dict[tuple[int, ...], Any]:
        """OpenVINO's queues of requests, one per shape; new shapes are compiled in parallel."""
        new = [shape for shape in sorted(shapes) if (shape, streams) not in self._compiled]
        if new:
            with ThreadPoolExecutor(min(self._threads, len(new))) as pool:
                compiled = pool.map(lambda shape: self._compile(shape, streams), new)
                self._compiled.update({(shape, streams): queue for shape, queue in zip(new, compiled, strict=True)})
        for shape in shapes:
            self._compiled.move_to_end((shape, streams))
        queues = {shape: self._compiled[shape, streams] for shape in shapes}
        while len(self._compiled) > MAX_COMPILED:
            self._compiled.popitem(last=False)
        return queues

    def _compile(self, shape: tuple[int, ...], streams: int) -> Any:
        model = self._model.clone()
        model.reshape(list(shape))
        settings = {
            "NUM_STREAMS": streams,
            "INFERENCE_NUM_THREADS": self._threads,
            # Threads of several compiled sizes and processes would be pinned to the same core.
            "ENABLE_CPU_PINNING": False,
            # By default, OpenVINO computes in half precision if the CPU supports it.
            "INFERENCE_PRECISION_HINT": "bf16" if self.backend == "openvino-bf16" else "f32",
        }
        compiled = self._core.compile_model(model, "CPU", settings)
        return openvino().AsyncInferQueue(compiled, IN_FLIGHT * streams)


def _cut(batch: Batch, lengths: Sequence[int]) -> list[Batch]:
    ends = np.cumsum(lengths)
    return [batch[end - length : end] for end, length in zip(ends, lengths, strict=True)]


def _reason(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__
