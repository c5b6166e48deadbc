"""The one door to OpenVINO: what is switched off before it loads."""

from __future__ import annotations

import sys
import threading
from functools import lru_cache
from typing import Any

import numpy as np

from annotator.types.errors import DetectionError

# Imported by OpenVINO as it loads, it reports to a service on the network and keeps an id in the user's home. Where it
# cannot be imported, OpenVINO does without.
TELEMETRY = "openvino_telemetry"

_LOCK = threading.Lock()


def openvino() -> Any:
    """The module `openvino`, loaded on the first call.

    Raises:
        DetectionError: it is missing or broken.
    """
    with _LOCK:
        return _load()


def computes_bfloat16() -> bool:
    """Whether the processor has instructions for bfloat16 (AVX512-BF16, AMX, AVX2-VNNI-2), and OpenVINO uses them.

    Raises:
        DetectionError: it is missing or broken.
    """
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
        sys.modules[TELEMETRY] = None  # type: ignore[assignment]  # the import system's way to say: not there
    try:
        import openvino as module
        import openvino.tools.ovc.convert_impl  # what would otherwise load with the first conversion
    except ImportError as error:
        raise DetectionError(f"OpenVINO cannot be loaded ({error}); run: pip install openvino") from error
    finally:
        if hidden:
            del sys.modules[TELEMETRY]
    # Its bindings set up their use of numpy on first use, and two threads that come first together wait for each other
    # for ever: one holds Python's lock, the other the bindings' own.
    module.Type.u8.to_dtype()
    _ = module.Tensor(np.zeros(1, np.uint8)).data
    return module
