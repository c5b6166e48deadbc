"""A network on ONNX Runtime, for machines without OpenVINO. Only this module imports it; its telemetry is off."""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from annotator.detection.backends.network import (
    Answer,
    Batch,
    Image,
    NetworkFacts,
    rejoined,
    side_by_side,
    single,
    usable_cores,
)
from annotator.detection.config import Backend
from annotator.types.errors import DetectionError, MissingExtraError

# Read on import. If it is not set, the official builds send telemetry and store an id and a database in the user's
# home.
SWITCH = "ORT_DISABLE_TELEMETRY"


def onnxruntime() -> Any:
    """The module `onnxruntime`, loaded on the first call."""
    os.environ.setdefault(SWITCH, "1")
    try:
        import onnxruntime as module
    except ImportError as error:
        raise MissingExtraError("onnxruntime", "onnx") from error
    return module


ERRORS_ONLY = 3  # ONNX Runtime's log severity


class OnnxNetwork:
    """A network that ONNX Runtime runs on the CPU."""

    backend: Backend = "onnxruntime"
    device = "cpu"

    def __init__(self, facts: NetworkFacts, parts: Mapping[str, bytes], threads: int | None) -> None:
        """
        Args:
            threads: CPU threads; None: all cores that the process may use.
        """
        self.facts = facts
        self._threads = threads or usable_cores()
        self._pool = ThreadPoolExecutor(self._threads, "detector") if self._threads > 1 else None
        self._content = parts["network.onnx"]
        self._lock = threading.Lock()
        self._sessions: dict[int, Any] = {}
        self._session(1)

    def predict(self, batches: Sequence[Batch]) -> list[Answer]:
        """As `Network.predict`."""
        images = single(batches)
        many = side_by_side(len(images), self._threads)
        session = self._session(1 if many else self._threads)

        def predict_one(image: Image) -> Answer:
            answer: Answer = session.run(None, {"pixels": image})[0]
            return answer

        try:
            answers = self._pool.map(predict_one, images) if many and self._pool else map(predict_one, images)
            return rejoined(answers, batches)
        except Exception as error:
            raise DetectionError(f"ONNX Runtime cannot run the detector ({error}); use the backend torch") from error

    def _session(self, threads: int) -> Any:
        """The session that computes an image with this number of threads; created on first use."""
        with self._lock:
            if threads not in self._sessions:
                self._sessions[threads] = _open(self._content, threads)
            return self._sessions[threads]


def _open(content: bytes, threads: int) -> Any:
    runtime = onnxruntime()
    options = runtime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = ERRORS_ONLY
    # By default, waiting threads spin and block cores for other work.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        return runtime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime has its own exception types
        reason = str(error).strip().splitlines()[0]
        raise DetectionError(f"ONNX Runtime cannot read the exported detector ({reason})") from error
