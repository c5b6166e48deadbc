"""The only module that imports OpenVINO; switches off its telemetry first."""

from __future__ import annotations

import sys
import threading
from functools import lru_cache
from typing import Any

import numpy as np

from annotator.types.errors import DetectionError

# OpenVINO imports this package when it loads. The package sends telemetry and stores an id in the user's home. OpenVINO
# works without it.
TELEMETRY = "openvino_telemetry"

_LOCK = threading.Lock()


def openvino() -> Any:
    """The module `openvino`, loaded on the first call.

    Raises:
        DetectionError: OpenVINO is missing or broken.
    """
    with _LOCK:
        return _load()


def computes_bfloat16() -> bool:
    """Whether the CPU has instructions for bfloat16 (AVX512-BF16, AMX, AVX2-VNNI-2) and OpenVINO uses them.

    Raises:
        DetectionError: OpenVINO is missing or broken.
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
